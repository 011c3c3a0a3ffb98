/* A trial board: the tension loop, one trial at a time, its record and its own guard.
 *
 * Compile it with estune_board.h and estune_pidf.c, which estune writes beside it from the rig's
 * file. The board provides the functions below and calls estune_board_sample once in each
 * sampling period. C99, without allocation, and no library but exp and memcpy. Setpoints and record
 * take the memory that estune_board.h states; define estune_stored as float to halve it.
 *
 * The computer is heard by packets (docs/how-to/hardware.md). When it falls silent for ESTUNE_SILENCE
 * samples, or a limit is crossed, the effort is brought to zero and the amplifier switched off by
 * the board alone.
 */
#include <math.h>
#include <string.h>

#define ESTUNE_PIDF_EXPORT static inline
#include "estune_pidf.c"
#include "estune_board.h"
#ifdef ESTUNE_COMPENSATED
#include "estune_compensation.c"
#endif

/* Provided by the board. A tension that cannot be measured is NAN. */
double board_tension_N(void);
double board_angle_rad(void);
void board_effort_N(double effort); /* also feeds the amplifier's watchdog */
void board_power(int on);
int board_receive(void); /* the next byte that has arrived, or -1 */
void board_send(const unsigned char *bytes, int size);

enum state { OFF, TAKE_UP, MOVE, HOLD, TRIAL, RAMP };
enum outcome { NONE, DONE, GUARD, CANCELLED, INTERRUPTED };
enum reason { NO_REASON, TENSION, TRAVEL, SILENCE, ABORT, ESTOP, NOT_TAUT, NOT_SETTLED, SENSOR };

#ifdef ESTUNE_COMPENSATED
#define TERMS 8 /* velocity, gravity, friction, inertia, map, notch, eyelet, limit */
#else
#define TERMS 0
#endif
#define NUMBERS (3 + TERMS) /* tension, effort and angle before them */

#ifndef estune_stored
#define estune_stored double
#endif

typedef struct {
  estune_stored numbers[NUMBERS];
  unsigned char flags;
} sample;

static struct {
  enum state state;
  unsigned char latched, pending, open_loop, outcome, reason;
  unsigned trial, samples, done, silent, since, settled;
  double setpoint, target, effort, ramp, origin, forward, limit;
  estune_pidf pidf;
  double live[ESTUNE_COEFFICIENTS], temporary[ESTUNE_COEFFICIENTS];
} board;

static estune_stored setpoints[ESTUNE_CAPACITY];
static sample record[ESTUNE_CAPACITY];

/* --- the loop -------------------------------------------------------------------------------- */

#ifdef ESTUNE_COMPENSATED
static estune_compensation compensation;

static void uncompensated(void) {
  compensation.gravity = compensation.friction = compensation.inertia = 0;
  compensation.map = compensation.notch = compensation.eyelet = compensation.limit = 0;
}

/* The tension that is controlled; in an open loop nothing is altered. */
static double compensate(double gauge, double angle) {
  static double samples;
  int closed =
      board.state == MOVE || board.state == HOLD || (board.state == TRIAL && !board.open_loop);
  estune_compensation_sample(&compensation, ++samples / ESTUNE_PIDF_SAMPLING_HZ, gauge, angle,
                             closed ? estune_pidf_setpoint(&board.pidf) : NAN, 0);
  if (board.state == TRIAL && board.open_loop) uncompensated();
  board.forward = estune_compensation_forward(&compensation);
  board.limit = compensation.limit;
  return gauge - estune_compensation_off(&compensation);
}
#else
static double compensate(double gauge, double angle) {
  (void)angle;
  return gauge;
}
#endif

static double step(double tension, casadi_real *excess) {
  return estune_pidf_step_beside(&board.pidf, board.forward, board.limit, board.setpoint, tension,
                                 excess);
}

static void take_over(double tension) {
  estune_pidf_take_over(&board.pidf, board.setpoint, tension, board.effort - board.forward);
}

static void use(const double *coefficients) {
  memcpy(board.pidf.coefficients, coefficients, sizeof board.pidf.coefficients);
}

static void enter(enum state state) {
  board.state = state;
  board.since = board.settled = 0;
}

/* Ends the trial, if one is pending or under way, and brings the effort to zero. */
static void stop(enum outcome outcome, enum reason reason, int latch) {
  if (board.pending) {
    board.outcome = outcome;
    board.reason = reason;
    board.pending = 0;
  } else if (latch) {
    board.reason = reason;
  }
  board.latched |= latch;
  if (board.state != OFF && board.state != RAMP) {
    board.ramp = board.effort / ESTUNE_RAMP;
    enter(RAMP);
  }
}

/* Restores the live gains without a jump of the effort, and returns to the tension held. */
static void end_trial(double tension, enum outcome outcome) {
  use(board.live);
  take_over(tension);
  board.outcome = outcome;
  board.pending = 0;
  board.target = ESTUNE_HOLD;
  enter(MOVE);
}

static void begin_trial(double tension) {
  use(board.temporary);
  take_over(tension);
  board.done = 0;
  enter(TRIAL);
}

/* A limit of the board's own: that of the tension, or of the travel since the trial was asked. */
static enum reason crossed(double tension, double angle) {
  if (tension != tension || angle != angle) return SENSOR; /* NAN */
  if (tension >= ESTUNE_TENSION_GUARD) return TENSION;
  if (fabs(angle - board.origin) >= ESTUNE_TRAVEL_GUARD) return TRAVEL;
  return NO_REASON;
}

static void move(double tension) {
  double left = board.target - board.setpoint;
  board.setpoint += fmin(fmax(left, -ESTUNE_RATE), ESTUNE_RATE);
  board.effort = step(tension, 0);
  board.settled = fabs(tension - board.target) < ESTUNE_SETTLE_N ? board.settled + 1 : 0;
  if (board.settled > ESTUNE_SETTLE) {
    if (board.pending) begin_trial(tension);
    else enter(HOLD);
  } else if (board.since > ESTUNE_SETTLE_WITHIN) {
    stop(GUARD, NOT_SETTLED, 0);
  }
}

static void trial(double tension, double angle) {
  casadi_real excess = 0;
  sample *now = &record[board.done];
  board.setpoint = setpoints[board.done];
  if (board.open_loop)
    board.effort = fmin(fmax(board.setpoint, ESTUNE_EFFORT_MIN), ESTUNE_EFFORT_MAX);
  else
    board.effort = step(tension, &excess);
  now->numbers[0] = (estune_stored)tension;
  now->numbers[1] = (estune_stored)board.effort;
  now->numbers[2] = (estune_stored)angle;
#ifdef ESTUNE_COMPENSATED
  if (board.open_loop) uncompensated();
  now->numbers[3] = (estune_stored)compensation.velocity;
  now->numbers[4] = (estune_stored)compensation.gravity;
  now->numbers[5] = (estune_stored)compensation.friction;
  now->numbers[6] = (estune_stored)compensation.inertia;
  now->numbers[7] = (estune_stored)compensation.map;
  now->numbers[8] = (estune_stored)compensation.notch;
  now->numbers[9] = (estune_stored)compensation.eyelet;
  now->numbers[10] = (estune_stored)compensation.limit;
#endif
  now->flags = excess != 0;
  if (++board.done == board.samples) end_trial(tension, DONE);
}

static void loop(double tension, double angle) {
  switch (board.state) {
    case OFF:
      break;
    case TAKE_UP:
      board.effort = ESTUNE_TAKE_UP;
      if (tension >= ESTUNE_TAUT) {
        use(board.live);
        estune_pidf_at_rest(&board.pidf, tension, board.effort - board.forward);
        board.setpoint = tension;
        enter(MOVE);
        move(tension);
      } else if (board.since > ESTUNE_TAKE_UP_WITHIN) {
        stop(GUARD, NOT_TAUT, 1);
      }
      break;
    case MOVE:
      move(tension);
      if (board.state == TRIAL) trial(tension, angle);
      break;
    case HOLD:
      board.effort = step(tension, 0);
      break;
    case TRIAL:
      trial(tension, angle);
      break;
    case RAMP:
      board.effort -= board.ramp;
      if (board.since >= ESTUNE_RAMP) {
        board.effort = 0;
        board_power(0);
        enter(OFF);
      }
      break;
  }
  board.since++;
}

/* --- packets --------------------------------------------------------------------------------- */

#define BEGINS 0xC3
#define HEAD 6 /* begin, kind, sequence number, length */
#define LONGEST 240
#define ROW (8 * NUMBERS + 1)

static unsigned checksum(const unsigned char *bytes, int size) {
  unsigned crc = 0xFFFF;
  int bit;
  for (; size > 0; size--) {
    crc ^= (unsigned)*bytes++ << 8;
    for (bit = 0; bit < 8; bit++) crc = (crc & 0x8000 ? crc << 1 ^ 0x1021 : crc << 1) & 0xFFFF;
  }
  return crc;
}

static unsigned get(const unsigned char *bytes, int size) {
  unsigned value = 0;
  while (size-- > 0) value = value << 8 | bytes[size];
  return value;
}

static unsigned char *put(unsigned char *bytes, unsigned value, int size) {
  for (; size > 0; size--, value >>= 8) *bytes++ = value & 0xFF;
  return bytes;
}

/* Doubles cross the line as the board keeps them: little-endian, as all common cores. */
static unsigned char *put_number(unsigned char *bytes, double value) {
  memcpy(bytes, &value, 8);
  return bytes + 8;
}

static void answer(unsigned kind, unsigned sequence, const unsigned char *body, int size) {
  unsigned char packet[HEAD + LONGEST + 2], *end = packet;
  end = put(end, BEGINS, 1);
  end = put(end, kind, 1);
  end = put(end, sequence, 2);
  end = put(end, (unsigned)size, 2);
  memcpy(end, body, (size_t)size);
  end += size;
  end = put(end, checksum(packet, (int)(end - packet)), 2);
  board_send(packet, (int)(end - packet));
}

static int status(unsigned char *body) {
  const unsigned char bytes[] = {board.state, board.latched, board.pending, board.outcome,
                                 board.reason};
  unsigned char *end = body + sizeof bytes;
  memcpy(body, bytes, sizeof bytes);
  end = put(end, board.trial, 4);
  return (int)(put(end, board.done, 4) - body);
}

/* Part of a trial's setpoints, refused as a whole where there is no room for it. */
static void store(unsigned first, const unsigned char *body, unsigned count) {
  double value;
  if (board.pending || first > ESTUNE_CAPACITY || count > ESTUNE_CAPACITY - first) return;
  for (; count > 0; count--, body += 8) {
    memcpy(&value, body, 8);
    setpoints[first++] = (estune_stored)value;
  }
}

/* A trial is accepted once: the same number again is a repetition of the request. */
static void accept(const unsigned char *body, double angle) {
  unsigned samples = get(body + 4, 4);
  if (board.latched || board.pending || get(body, 4) == board.trial) return;
  if (samples < 1 || samples > ESTUNE_CAPACITY || board.state == RAMP) return;
  board.trial = get(body, 4);
  board.samples = samples;
  board.open_loop = body[8];
  memcpy(&board.target, body + 9, 8);
  memcpy(board.temporary, body + 17, sizeof board.temporary);
  board.outcome = NONE;
  board.reason = NO_REASON;
  board.done = 0;
  board.pending = 1;
  board.origin = angle;
  if (board.state == OFF) board_power(1);
  enter(board.state == OFF ? TAKE_UP : MOVE);
}

static int rows(unsigned char *body, unsigned first, unsigned count) {
  unsigned char *end = put(body, first, 4);
  int number;
  for (; count > 0 && first < board.done; count--, first++) {
    for (number = 0; number < NUMBERS; number++)
      end = put_number(end, record[first].numbers[number]);
    *end++ = record[first].flags;
  }
  return (int)(end - body);
}

static void execute(unsigned kind, unsigned sequence, const unsigned char *body, int size,
                    double tension, double angle) {
  unsigned char out[LONGEST];
  board.silent = 0;
  if (kind == 'r' && size == 5 && body[4] <= (LONGEST - 4) / ROW) {
    size = rows(out, get(body, 4), body[4]);
    answer(kind, sequence, out, size);
    return;
  }
  if (kind == 'p' && size >= 4) {
    store(get(body, 4), body + 4, (unsigned)(size - 4) / 8);
  } else if (kind == 't' && size == 17 + (int)sizeof board.temporary) {
    accept(body, angle);
  } else if (kind == 'g' && size == (int)sizeof board.live && !board.latched) {
    memcpy(board.live, body, sizeof board.live);
    if (board.state == MOVE || board.state == HOLD) {
      use(board.live);
      take_over(tension);
    }
  } else if (kind == 'a') {
    if (board.state == TRIAL) {
      board.reason = ABORT;
      end_trial(tension, CANCELLED);
    } else if (board.pending) {
      stop(CANCELLED, ABORT, 0);
    }
  } else if (kind == 'x') {
    stop(CANCELLED, ESTOP, 1);
  } else if (kind == 'c') {
    board.latched = 0;
  }
  answer(kind, sequence, out, status(out));
}

static void receive(double tension, double angle) {
  static unsigned char packet[HEAD + LONGEST + 2];
  static int size;
  int byte, length, taken;
  while ((byte = board_receive()) >= 0) {
    packet[size++] = (unsigned char)byte;
    while (size) {
      length = size >= HEAD ? (int)get(packet + 4, 2) : 0;
      taken = 1; /* where no packet begins, or a damaged one */
      if (packet[0] == BEGINS && length <= LONGEST) {
        if (size < HEAD + length + 2) break;
        if (checksum(packet, HEAD + length) == get(packet + HEAD + length, 2)) {
          execute(packet[1], get(packet + 2, 2), packet + HEAD, length, tension, angle);
          taken = HEAD + length + 2;
        }
      }
      size -= taken;
      memmove(packet, packet + taken, (size_t)size);
    }
  }
}

/* --- for the board --------------------------------------------------------------------------- */

void estune_board_init(void) {
  memset(&board, 0, sizeof board);
  estune_pidf_init(&board.pidf);
  memcpy(board.live, board.pidf.coefficients, sizeof board.live);
  board_power(0);
}

void estune_board_sample(void) {
  double gauge = board_tension_N(), angle = board_angle_rad(), tension = compensate(gauge, angle);
  enum reason limit;
  receive(tension, angle);
  board.silent++;
  if (board.state != OFF && board.state != RAMP) {
    limit = crossed(gauge, angle);
    if (limit == SENSOR) stop(INTERRUPTED, SENSOR, 1); /* says nothing of the gains */
    else if (limit) stop(GUARD, limit, board.state != TRIAL);
    else if (board.silent > ESTUNE_SILENCE) stop(INTERRUPTED, SILENCE, 0);
  }
  loop(tension, angle);
  if (board.state != OFF) board_effort_N(board.effort);
}
