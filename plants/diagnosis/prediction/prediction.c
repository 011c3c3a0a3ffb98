/* Predictions of records: a fixed loop around the generated functions estune_late, estune_prepare,
 * estune_settle and estune_drive, and rows_locate, rows_place, rows_sense and rows_substep, which
 * work out LANES rows at once. They precede this text in the compiled file together with the sizes
 * CONSTANTS, STATES, SUBSTEPS, PARAMETERS, PLACED and DELAY, the place of the whole samples of dead
 * time among the parameters.
 *
 * The dead time is a ring of past drives as in trial_loop.c. At the start of each window the plant
 * is put where the record has it; what it remembers besides, and the ring, go on. The residuals
 * then lose what another start of each window would explain, by directions that are orthonormal.
 */
#include <stdlib.h>
#include <string.h>

#define APART static __attribute__((noinline))

enum { TENSION, ANGLE, REFERENCE, CURRENT, CHANNELS };
enum {
  ANGLE_ZERO, CURRENT_GAIN, CURRENT_OFFSET, REFERENCE_OFFSET, INPUT_SLOPE, INPUT_BEFORE, SENSORS
};

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
  const long *source;              /* [entries] place in the channels of the records */
  const long *block_end;           /* [blocks] */
  const long *record_blocks;       /* [records] number of them */
  const char *wanted;              /* [records] whether it is run, or null for all */
  const double *basis;             /* [PLACED][entries] */
  double *outputs;                 /* [rows], of each record [CHANNELS][its samples], or null */
  const long *chosen;              /* [kept] numbers of the entries whose residuals are told */
  double *residuals;               /* [rows][kept], or null */
} Task;

/* The ring: drives[n] is that of every row, the rows' dead times differ in what they read. */
typedef struct {
  Vector *drives;
  long room;
} Ring;

/* Rows on their way through a record. */
typedef struct {
  Vector constants[CONSTANTS], state[STATES], kick[PLACED];
  Vector slope, zero, gain, offset, reference_offset;
  Vector *drives; /* the ring */
  long size, delay[LANES], now;
  int first_order, kicked;
} Rows;

/* The rows' numbers where a record begins; the longest dead time among them, samples. */
APART long numbers(Rows *rows, long l, long samples, const double *given, double preload,
                   double reading, double command, int at_rest) {
  const double *sensor = given + PARAMETERS;
  double parameters[PARAMETERS], constants[CONSTANTS], state[STATES], moved[STATES], late, drive;
  const double *arg[3];
  double *res[2];
  long i;
  memcpy(parameters, given, sizeof parameters);
  arg[0] = parameters; res[0] = &late;
  estune_late(arg, res, 0, 0, 0);
  /* Rounding must not turn a whole sample into all but one. A dead time that is not finite, or
   * longer than the record, predicts nothing but the start. */
  late += 1e-9;
  rows->delay[l] = late < samples ? (late > 0.0 ? (long)late : 0) : samples;
  parameters[DELAY] = rows->delay[l];
  arg[0] = parameters; arg[1] = &preload;
  res[0] = constants;
  estune_prepare(arg, res, 0, 0, 0);
  arg[0] = constants; arg[1] = &reading;
  res[0] = state; res[1] = &drive;
  estune_settle(arg, res, 0, 0, 0);
  arg[1] = state; arg[2] = &command;
  if (!at_rest) { /* what was commanded before is not recorded */
    const double before = command + sensor[INPUT_BEFORE];
    arg[2] = &before;
    res[0] = moved; res[1] = &drive;
    estune_drive(arg, res, 0, 0, 0);
    arg[2] = &command;
  }
  rows->drives[0][l] = drive;
  if (rows->first_order) {
    res[0] = moved; res[1] = &drive;
    estune_drive(arg, res, 0, 0, 0);
    memcpy(state, moved, sizeof moved);
  }
  rows->drives[1][l] = drive;
  for (i = 0; i < CONSTANTS; i++) rows->constants[i][l] = constants[i];
  for (i = 0; i < STATES; i++) rows->state[i][l] = state[i];
  rows->slope[l] = sensor[INPUT_SLOPE];
  rows->zero[l] = sensor[ANGLE_ZERO];
  rows->gain[l] = sensor[CURRENT_GAIN];
  rows->offset[l] = sensor[CURRENT_OFFSET];
  rows->reference_offset[l] = sensor[REFERENCE_OFFSET];
  return rows->delay[l];
}

/* Puts the plants where a window begins, and a kick from there. */
APART void begin(Rows *rows, const double *to) {
  Vector place[PLACED ? PLACED : 1], moved[STATES];
  const Vector *arg[3];
  Vector *res[1];
  long i;
  arg[0] = rows->constants; arg[1] = rows->state; arg[2] = place;
  if (to) {
    for (i = 0; i < PLACED; i++) place[i] = ALL(to[i]);
    place[0] -= rows->zero;
  } else {
    if (!rows->kicked) return;
    res[0] = place;
    rows_locate(arg, res);
  }
  if (rows->kicked) for (i = 0; i < PLACED; i++) place[i] += rows->kick[i];
  res[0] = moved;
  rows_place(arg, res);
  memcpy(rows->state, moved, sizeof moved);
}

/* A stretch of what is predicted: one record. */
typedef struct {
  long samples, windows;
  const double *command;      /* [samples] */
  const long *window_at;      /* [windows] */
  const double *window_place; /* [windows][PLACED] */
} Stretch;

WITHIN long wrapped(long n, long size) { return n < 0 ? n + size : n < size ? n : n - size; }

/* A record, of rows that are ready for it; channels are [CHANNELS][apart]. */
WITHIN void run(const Rows *ready, Stretch record, Vector *channels, long apart) {
  Rows rows = *ready; /* that nothing else points to: what is in it may stay in registers */
  long k, n, l, i, w = 0;
  for (k = 0; k < record.samples; k++) {
    Vector moved[STATES], earlier, later, next, command, outside;
    const Vector *arg[5];
    Vector *res[5];
    /* The drive of command j is that of ring place j + 1; what goes straight from sample to
     * sample has to be known one sample ahead. */
    const long to = wrapped(rows.now + rows.first_order, rows.size);
    if (w < record.windows && record.window_at[w] == k)
      begin(&rows, record.window_place + PLACED * w++);
    command = ALL(record.command[k + (rows.first_order && k + 1 < record.samples)]);
    for (l = 0; l < LANES; l++)
      earlier[l] = rows.drives[wrapped(rows.now - rows.delay[l] - 1, rows.size)][l];
    arg[0] = rows.constants; arg[1] = rows.state; arg[2] = &earlier; arg[3] = &command;
    res[0] = moved; res[1] = channels + TENSION * apart + k;
    res[2] = channels + ANGLE * apart + k; res[3] = &outside; res[4] = rows.drives + to;
    rows_sense(arg, res);
    channels[ANGLE * apart + k] += rows.zero;
    channels[REFERENCE * apart + k] = outside + rows.reference_offset;
    channels[CURRENT * apart + k] = rows.gain * rows.drives[rows.now] + rows.offset;
    for (i = 0; i < STATES; i++) rows.state[i] = moved[i];
    for (l = 0; l < LANES; l++) {
      later[l] = rows.drives[wrapped(rows.now - rows.delay[l], rows.size)][l];
      next[l] = rows.drives[wrapped(rows.now - rows.delay[l] + 1, rows.size)][l];
    }
    for (n = 0; n < SUBSTEPS; n++) {
      Vector place = ALL((double)n), from = earlier, onto = later;
      if (rows.first_order) {
        const Vector share = rows.slope * (n + 0.5) / (double)SUBSTEPS;
        from = earlier + share * (later - earlier);
        onto = later + share * (next - later);
      }
      arg[2] = &from; arg[3] = &onto; arg[4] = &place;
      res[0] = moved;
      rows_substep(arg, res);
      for (i = 0; i < STATES; i++) rows.state[i] = moved[i];
    }
    rows.now = wrapped(rows.now + 1, rows.size);
  }
}

/* Whitened residuals of some blocks of the rows, without what the windows' starts explain. */
APART void reduce(const Task *task, long begin, long end, const Vector *channels,
                  long first_channel, Vector *residuals) {
  long b, d, e, first = begin ? task->block_end[begin - 1] : 0;
  for (b = begin; b < end; b++) {
    for (e = first; e < task->block_end[b]; e++) {
      Vector r = (task->measured[e] - channels[task->source[e] - first_channel]) *
                 task->weight[e];
      r = pick(r <= FURTHEST, r, ALL(FURTHEST)); /* also where it is not a number */
      residuals[e] = pick(r < -FURTHEST, ALL(-FURTHEST), r);
    }
    for (d = 0; task->basis && d < PLACED; d++) {
      const double *direction = task->basis + d * task->entries;
      Vector share = ALL(0.0);
      for (e = first; e < task->block_end[b]; e++) share += direction[e] * residuals[e];
      for (e = first; e < task->block_end[b]; e++) residuals[e] -= share * direction[e];
    }
    first = task->block_end[b];
  }
}

/* Rows ready for a record; zero, or nonzero without memory. Rows beyond the last repeat it. */
APART int ready(const Task *task, Rows *rows, Ring *ring, long m, long r, Stretch record,
                int at_rest) {
  const long width = PARAMETERS + SENSORS;
  const double *given[LANES];
  Vector started[2];
  long l, i, longest = 0;
  rows->drives = started;
  rows->kicked = task->kick != 0;
  rows->first_order = 0;
  for (l = 0; l < LANES; l++) {
    const long row = m + l < task->rows ? m + l : task->rows - 1;
    given[l] = task->table + (row * task->records + r) * width;
    rows->first_order |= given[l][PARAMETERS + INPUT_SLOPE] > 0.0;
  }
  for (l = 0; l < LANES; l++) {
    const long row = m + l < task->rows ? m + l : task->rows - 1;
    const long delay = numbers(rows, l, record.samples, given[l], task->preload[r],
                               task->reading[r], *record.command, at_rest);
    if (delay > longest) longest = delay;
    for (i = 0; i < PLACED && rows->kicked; i++)
      rows->kick[i][l] = task->kick[row * PLACED + i];
  }
  rows->size = longest + 3;
  if (ring->room < rows->size) {
    free(ring->drives);
    ring->room = rows->size;
    if (posix_memalign((void **)&ring->drives, sizeof(Vector), ring->room * sizeof(Vector))) {
      ring->drives = 0;
      return 1;
    }
  }
  rows->drives = ring->drives;
  for (i = 0; i < rows->size; i++) rows->drives[i] = started[0];
  rows->now = 0;
  if (rows->first_order) rows->drives[rows->now] = started[1];
  if (at_rest) begin(rows, 0);
  return 0;
}

/* Number of states that are reset. */
__attribute__((visibility("default"))) const int estune_placed = PLACED;

/* Runs all rows; zero, or nonzero without memory. What is called for each sample is in place. */
__attribute__((visibility("default"), flatten)) int estune_predict(const Task *task) {
  const long samples = task->samples;
  Vector *channels = 0, *left = 0;
  Ring ring = {0, 0};
  Rows rows;
  long m, r, k, l, c, held = 0;
  int failed = 0;
  /* Where only residuals are wanted, all records have the channels of one in turn. */
  for (r = 0; r < task->records; r++)
    if (task->record_samples[r] > held) held = task->record_samples[r];
  if (task->outputs) held = samples;
  failed |= posix_memalign((void **)&channels, sizeof(Vector), CHANNELS * held * sizeof(Vector));
  if (task->residuals)
    failed |= posix_memalign((void **)&left, sizeof(Vector), task->entries * sizeof(Vector));
  for (m = 0; m < task->rows && !failed; m += LANES) {
    const long many = task->rows - m < LANES ? task->rows - m : LANES;
    long at = 0, w = 0, b = 0;
    for (r = 0; r < task->records && !failed; r++) {
      const Stretch record = {task->record_samples[r], task->windows[r], task->command + at,
                              task->window_at + w, task->window_place + w * PLACED};
      const long blocks = b + task->record_blocks[r];
      const int at_rest = !record.windows || record.window_at[0] != 0;
      const long place = task->outputs ? 0 : CHANNELS * at; /* of the first channel held */
      if (!task->wanted || task->wanted[r]) {
        failed |= ready(task, &rows, &ring, m, r, record, at_rest);
        if (failed) break;
        run(&rows, record, channels + CHANNELS * at - place, record.samples);
        if (left) reduce(task, b, blocks, channels, place, left);
      }
      b = blocks;
      at += record.samples;
      w += record.windows;
    }
    for (l = 0; !failed && l < many; l++) {
      for (k = 0; left && k < task->kept; k++)
        task->residuals[(m + l) * task->kept + k] = left[task->chosen[k]][l];
      for (c = 0; task->outputs && c < CHANNELS * samples; c++)
        task->outputs[(m + l) * CHANNELS * samples + c] = channels[c][l];
    }
  }
  free(channels);
  free(left);
  free(ring.drives);
  return failed;
}
