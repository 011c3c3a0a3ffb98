/* Predictions of records: a fixed loop around the generated functions estune_late, estune_prepare,
 * estune_settle, estune_locate, estune_place, estune_drive, estune_sense and estune_substep, which
 * precede this text in the compiled file together with the sizes CONSTANTS, STATES, SUBSTEPS, PARAMETERS,
 * PLACED and DELAY, the place of the whole samples of dead time among the parameters.
 *
 * The dead time is a ring of past drives as in trial_loop.c. At the start of each window the plant
 * is put where the record has it; what it remembers besides, and the ring, go on. The residuals
 * then lose what another start of each window would explain, by directions that are orthonormal.
 *
 * Two rows run side by side: each waits for its own last substep, and the other's fills the time.
 */
#include <stdlib.h>
#include <string.h>

#define UNROLLED _Pragma("GCC unroll 128")
#define WITHIN static inline __attribute__((always_inline))
#define APART static __attribute__((noinline))

enum { SIDE_BY_SIDE = 2 };

enum { TENSION, ANGLE, REFERENCE, CURRENT, CHANNELS };
enum { ANGLE_ZERO, CURRENT_GAIN, CURRENT_OFFSET, REFERENCE_OFFSET, INPUT_SLOPE, SENSORS };

#define FURTHEST 1e6 /* what a prediction that runs away counts for, in sigmas */

typedef struct {
  long rows, records, samples, entries, kept;
  const long *record_samples;      /* [records] */
  const double *preload, *reading; /* [records]; reading at rest in the first sample */
  const double *command;           /* [samples], effort, records one after the other */
  const long *windows;             /* [records] number of them */
  const long *window_at;           /* sample of the record each begins with */
  const double *window_place;      /* [all windows][PLACED] */
  const double *table;             /* [rows][records][PARAMETERS + SENSORS] */
  const double *kick;              /* [rows][PLACED] added at each window's start, or null */
  const double *measured, *weight; /* [entries] */
  const long *source;              /* [entries] place in the channels of all samples */
  const long *block_end;           /* [blocks] */
  const long *record_blocks;       /* [records] number of them */
  const char *wanted;              /* [records] whether it is run, or null for all */
  const double *basis;             /* [PLACED][entries] */
  double *outputs;                 /* [rows][CHANNELS][samples], or null */
  const long *chosen;              /* [kept] numbers of the entries whose residuals are told */
  double *residuals;               /* [rows][kept], or null */
} Task;

typedef struct {
  double *drives;
  long room;
} Ring;

/* Puts the plant where a window begins, and a kick from there. */
static void begin(const double *constants, double *state, const double *to, double zero,
                  const double *kick) {
  double place[PLACED], moved[STATES];
  const double *arg[3];
  double *res[1];
  long i;
  if (to) {
    for (i = 0; i < PLACED; i++) place[i] = to[i];
    place[0] -= zero;
  } else {
    if (!kick) return;
    arg[0] = constants; arg[1] = state;
    res[0] = place;
    estune_locate(arg, res, 0, 0, 0);
  }
  if (kick) for (i = 0; i < PLACED; i++) place[i] += kick[i];
  arg[0] = constants; arg[1] = state; arg[2] = place;
  res[0] = moved;
  estune_place(arg, res, 0, 0, 0);
  memcpy(state, moved, sizeof moved);
}

/* The drive that a command gives, and the state after it. */
static double driven(const double *constants, const double *state, double *after, double command) {
  const double *arg[3];
  double *res[2], drive;
  arg[0] = constants; arg[1] = state; arg[2] = &command;
  res[0] = after; res[1] = &drive;
  estune_drive(arg, res, 0, 0, 0);
  return drive;
}

/* One row on its way through a record. */
typedef struct {
  double constants[CONSTANTS], state[STATES], slope;
  const double *sensor, *kick;
  double *drives; /* the ring */
  long size, before, after, now;
  double *tension, *angle, *reference, *current; /* [samples] */
} Lane;

/* A row where a record begins; zero, or nonzero without memory. */
APART int ready(Lane *lane, Ring *ring, long samples, const double *numbers, double preload,
                double reading, double command, int at_rest) {
  double parameters[PARAMETERS], moved[STATES], late, drive;
  long n, delay;
  lane->sensor = numbers + PARAMETERS;
  lane->slope = lane->sensor[INPUT_SLOPE];
  memcpy(parameters, numbers, sizeof parameters);
  {
    const double *arg[2];
    double *res[2];
    arg[0] = parameters; res[0] = &late;
    estune_late(arg, res, 0, 0, 0);
    /* Rounding must not turn a whole sample into all but one. A dead time that is not finite, or
     * longer than the record, predicts nothing but the start. */
    late += 1e-9;
    delay = late < samples ? (late > 0.0 ? (long)late : 0) : samples;
    parameters[DELAY] = delay;
    arg[0] = parameters; arg[1] = &preload;
    res[0] = lane->constants;
    estune_prepare(arg, res, 0, 0, 0);
    arg[0] = lane->constants; arg[1] = &reading;
    res[0] = lane->state; res[1] = &drive;
    estune_settle(arg, res, 0, 0, 0);
  }
  lane->size = delay + 3;
  if (ring->room < lane->size) {
    double *larger = realloc(ring->drives, lane->size * sizeof *larger);
    if (!larger) return 1;
    ring->drives = larger; ring->room = lane->size;
  }
  lane->drives = ring->drives;
  if (!at_rest) /* the first command is as good as the last */
    drive = driven(lane->constants, lane->state, moved, command);
  for (n = 0; n < lane->size; n++) lane->drives[n] = drive;
  /* The drive of command j is kept in place (j + delay + 1) mod size. What goes straight from
   * sample to sample has to be known one sample ahead. */
  lane->before = 0; lane->after = 1;
  lane->now = delay + 1 < lane->size ? delay + 1 : 0;
  if (lane->slope > 0.0) {
    lane->drives[lane->now] = driven(lane->constants, lane->state, moved, command);
    memcpy(lane->state, moved, sizeof moved);
  }
  if (at_rest) begin(lane->constants, lane->state, 0, 0.0, lane->kick);
  return 0;
}

/* What the sensors read in a sample, and the drive of its command or of the next. */
WITHIN void sense(Lane *lane, long sample, long last, const double *command) {
  double moved[STATES], outside;
  const double *arg[4];
  double *res[5];
  long i, to = lane->now;
  if (lane->slope > 0.0) {
    if (sample < last) command++;
    if (++to == lane->size) to = 0;
  }
  arg[0] = lane->constants; arg[1] = lane->state; arg[2] = lane->drives + lane->before;
  arg[3] = command;
  res[0] = moved; res[1] = lane->tension + sample; res[2] = lane->angle + sample;
  res[3] = &outside; res[4] = lane->drives + to;
  estune_sense(arg, res, 0, 0, 0);
  lane->angle[sample] += lane->sensor[ANGLE_ZERO];
  lane->reference[sample] = outside + lane->sensor[REFERENCE_OFFSET];
  lane->current[sample] = lane->sensor[CURRENT_GAIN] * lane->drives[lane->now] +
                          lane->sensor[CURRENT_OFFSET];
  UNROLLED
  for (i = 0; i < STATES; i++) lane->state[i] = moved[i];
}

WITHIN void substep(Lane *lane, long n) {
  const double *earlier = lane->drives + lane->before, *later = lane->drives + lane->after;
  double moved[STATES], place = n, from, to;
  const double *arg[5];
  double *res[1];
  long i;
  arg[0] = lane->constants; arg[1] = lane->state; arg[2] = earlier; arg[3] = later;
  arg[4] = &place;
  if (lane->slope > 0.0) {
    const double share = lane->slope * (n + 0.5) / SUBSTEPS;
    const long next = lane->after + 1 == lane->size ? 0 : lane->after + 1;
    from = *earlier + share * (*later - *earlier);
    to = *later + share * (lane->drives[next] - *later);
    arg[2] = &from; arg[3] = &to;
  }
  res[0] = moved;
  estune_substep(arg, res, 0, 0, 0);
  UNROLLED
  for (i = 0; i < STATES; i++) lane->state[i] = moved[i];
}

/* A stretch of what is predicted: one record. */
typedef struct {
  long samples, windows;
  const double *command;      /* [samples] */
  const long *window_at;      /* [windows] */
  const double *window_place; /* [windows][PLACED] */
} Stretch;

/* A record, of rows that are ready for it. */
WITHIN void run(const Lane *ready, const int many, Stretch record) {
  Lane lanes[SIDE_BY_SIDE]; /* that nothing else points to: what is in it may stay in registers */
  long k, n, w = 0;
  int l;
  memcpy(lanes, ready, many * sizeof *lanes);
  for (k = 0; k < record.samples; k++) {
    if (w < record.windows && record.window_at[w] == k) {
      for (l = 0; l < many; l++)
        begin(lanes[l].constants, lanes[l].state, record.window_place + w * PLACED,
              lanes[l].sensor[ANGLE_ZERO], lanes[l].kick);
      w++;
    }
    UNROLLED
    for (l = 0; l < many; l++) sense(lanes + l, k, record.samples - 1, record.command + k);
    for (n = 0; n < SUBSTEPS; n++) {
      UNROLLED
      for (l = 0; l < many; l++) substep(lanes + l, n);
    }
    UNROLLED
    for (l = 0; l < many; l++) {
      lanes[l].before = lanes[l].after;
      if (++lanes[l].after == lanes[l].size) lanes[l].after = 0;
      if (++lanes[l].now == lanes[l].size) lanes[l].now = 0;
    }
  }
}

/* Whitened residuals of some blocks of one row, without what the windows' starts explain. */
APART void reduce(const Task *task, long begin, long end, const double *outputs,
                  double *residuals) {
  long b, d, e, first = begin ? task->block_end[begin - 1] : 0;
  for (b = begin; b < end; b++) {
    for (e = first; e < task->block_end[b]; e++) {
      double r = (task->measured[e] - outputs[task->source[e]]) * task->weight[e];
      if (!(r <= FURTHEST)) r = FURTHEST; /* also where it is not a number */
      if (r < -FURTHEST) r = -FURTHEST;
      residuals[e] = r;
    }
    for (d = 0; task->basis && d < PLACED; d++) {
      const double *direction = task->basis + d * task->entries;
      double share = 0.0;
      for (e = first; e < task->block_end[b]; e++) share += direction[e] * residuals[e];
      for (e = first; e < task->block_end[b]; e++) residuals[e] -= share * direction[e];
    }
    first = task->block_end[b];
  }
}

/* Runs all rows; zero, or nonzero without memory. What is called for each sample is in place. */
__attribute__((visibility("default"), flatten)) int estune_predict(const Task *task) {
  const long width = PARAMETERS + SENSORS, samples = task->samples, room = CHANNELS * samples;
  double *scratch = 0, *left = 0;
  Ring rings[SIDE_BY_SIDE];
  Lane lanes[SIDE_BY_SIDE];
  long m, r, many, l;
  int failed = 0;
  memset(rings, 0, sizeof rings);
  if (!task->outputs) {
    scratch = malloc(SIDE_BY_SIDE * room * sizeof *scratch);
    if (!scratch) return 1;
  }
  if (task->residuals) {
    left = malloc(SIDE_BY_SIDE * task->entries * sizeof *left);
    failed = !left;
  }
  for (m = 0; m < task->rows && !failed; m += many) {
    double *out = scratch ? scratch : task->outputs + m * room;
    long at = 0, w = 0, b = 0;
    many = task->rows - m < SIDE_BY_SIDE ? 1 : SIDE_BY_SIDE;
    for (r = 0; r < task->records && !failed; r++) {
      const Stretch record = {task->record_samples[r], task->windows[r], task->command + at,
                              task->window_at + w, task->window_place + w * PLACED};
      const long blocks = b + task->record_blocks[r];
      const int at_rest = !record.windows || record.window_at[0] != 0;
      const int wanted = !task->wanted || task->wanted[r];
      for (l = 0; wanted && l < many; l++) {
        double *to = out + l * room + at;
        lanes[l].tension = to + TENSION * samples;
        lanes[l].angle = to + ANGLE * samples;
        lanes[l].reference = to + REFERENCE * samples;
        lanes[l].current = to + CURRENT * samples;
        lanes[l].kick = task->kick ? task->kick + (m + l) * PLACED : 0;
        failed |= ready(lanes + l, rings + l, record.samples,
                        task->table + ((m + l) * task->records + r) * width, task->preload[r],
                        task->reading[r], *record.command, at_rest);
      }
      if (wanted && !failed) {
        if (many == 1) run(lanes, 1, record);
        else run(lanes, SIDE_BY_SIDE, record);
        for (l = 0; left && l < many; l++)
          reduce(task, b, blocks, out + l * room, left + l * task->entries);
      }
      b = blocks;
      at += record.samples;
      w += record.windows;
    }
    for (l = 0; left && !failed && l < many; l++)
      for (r = 0; r < task->kept; r++)
        task->residuals[(m + l) * task->kept + r] = left[l * task->entries + task->chosen[r]];
  }
  free(scratch);
  free(left);
  for (l = 0; l < SIDE_BY_SIDE; l++) free(rings[l].drives);
  return failed;
}
