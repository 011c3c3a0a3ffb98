/* Predictions of records: a fixed loop around the generated functions estune_late, estune_prepare,
 * estune_settle, estune_locate, estune_place, estune_drive, estune_sense and estune_substep, which
 * precede this text in the compiled file together with the sizes CONSTANTS, STATES, SUBSTEPS, PARAMETERS,
 * PLACED and DELAY, the place of the whole samples of dead time among the parameters.
 *
 * The dead time is a ring of past drives as in trial_loop.c. At the start of each window the plant
 * is put where the record has it; what it remembers besides, and the ring, go on. The residuals
 * then lose what another start of each window would explain, by directions that are orthonormal.
 */
#include <stdlib.h>
#include <string.h>

#define UNROLLED _Pragma("GCC unroll 128")

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

/* One record with one set of parameters; zero, or nonzero without memory. */
static int one_record(long samples, const double *numbers, double preload, double reading,
                      const double *command, long windows, const long *window_at,
                      const double *window_place, const double *kick, Ring *ring, double *tension,
                      double *angle, double *reference, double *current) {
  double parameters[PARAMETERS], constants[CONSTANTS], state[STATES], moved[STATES], late, drive;
  const double *sensor = numbers + PARAMETERS;
  const double slope = sensor[INPUT_SLOPE];
  long i, k, n, w = 0, delay, size, now, before = 0, after = 1;
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
    res[0] = constants;
    estune_prepare(arg, res, 0, 0, 0);
    arg[0] = constants; arg[1] = &reading;
    res[0] = state; res[1] = &drive;
    estune_settle(arg, res, 0, 0, 0);
  }
  size = delay + 3;
  if (ring->room < size) {
    double *larger = realloc(ring->drives, size * sizeof *larger);
    if (!larger) return 1;
    ring->drives = larger; ring->room = size;
  }
  if (windows && window_at[0] == 0) /* not at rest: the first command is as good as the last */
    drive = driven(constants, state, moved, command[0]);
  for (n = 0; n < size; n++) ring->drives[n] = drive;
  /* The drive of command j is kept in place (j + delay + 1) mod size. What goes straight from
   * sample to sample has to be known one sample ahead. */
  now = delay + 1 < size ? delay + 1 : 0;
  if (slope > 0.0) {
    ring->drives[now] = driven(constants, state, moved, command[0]);
    memcpy(state, moved, sizeof moved);
  }
  if (!windows || window_at[0] != 0) begin(constants, state, 0, 0.0, kick); /* at rest */
  for (k = 0; k < samples; k++) {
    const double *earlier = ring->drives + before, *later = ring->drives + after;
    if (w < windows && window_at[w] == k) {
      begin(constants, state, window_place + w * PLACED, sensor[ANGLE_ZERO], kick);
      w++;
    }
    {
      const double *arg[4];
      double *res[5], outside;
      long ahead = slope > 0.0 && k + 1 < samples ? k + 1 : k, to = now;
      if (slope > 0.0 && ++to == size) to = 0;
      arg[0] = constants; arg[1] = state; arg[2] = earlier; arg[3] = command + ahead;
      res[0] = moved; res[1] = tension + k; res[2] = angle + k; res[3] = &outside;
      res[4] = ring->drives + to;
      estune_sense(arg, res, 0, 0, 0);
      angle[k] += sensor[ANGLE_ZERO];
      reference[k] = outside + sensor[REFERENCE_OFFSET];
      current[k] = sensor[CURRENT_GAIN] * ring->drives[now] + sensor[CURRENT_OFFSET];
    }
    UNROLLED
    for (i = 0; i < STATES; i++) state[i] = moved[i];
    for (n = 0; n < SUBSTEPS; n++) {
      const double *arg[5];
      double *res[1], place = n, from, to;
      arg[0] = constants; arg[1] = state; arg[2] = earlier; arg[3] = later; arg[4] = &place;
      if (slope > 0.0) {
        const double share = slope * (n + 0.5) / SUBSTEPS;
        from = *earlier + share * (*later - *earlier);
        to = *later + share * (ring->drives[after + 1 == size ? 0 : after + 1] - *later);
        arg[2] = &from; arg[3] = &to;
      }
      res[0] = moved;
      estune_substep(arg, res, 0, 0, 0);
      UNROLLED
      for (i = 0; i < STATES; i++) state[i] = moved[i];
    }
    before = after;
    if (++after == size) after = 0;
    if (++now == size) now = 0;
  }
  return 0;
}

/* Whitened residuals of some blocks of one row, without what the windows' starts explain. */
static void reduce(const Task *task, long begin, long end, const double *outputs,
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

/* Runs all rows; zero, or nonzero without memory. */
__attribute__((visibility("default"))) int estune_predict(const Task *task) {
  const long width = PARAMETERS + SENSORS;
  double *scratch = 0, *left = 0;
  Ring ring = {0, 0};
  long m, r;
  int failed = 0;
  if (!task->outputs) {
    scratch = malloc(CHANNELS * task->samples * sizeof *scratch);
    if (!scratch) return 1;
  }
  if (task->residuals) {
    left = malloc(task->entries * sizeof *left);
    failed = !left;
  }
  for (m = 0; m < task->rows && !failed; m++) {
    double *out = scratch ? scratch : task->outputs + m * CHANNELS * task->samples;
    const double *kick = task->kick ? task->kick + m * PLACED : 0;
    long at = 0, w = 0, b = 0;
    for (r = 0; r < task->records && !failed; r++) {
      const long blocks = b + task->record_blocks[r];
      if (!task->wanted || task->wanted[r]) {
        failed = one_record(task->record_samples[r],
                            task->table + (m * task->records + r) * width, task->preload[r],
                            task->reading[r], task->command + at, task->windows[r],
                            task->window_at + w, task->window_place + w * PLACED, kick, &ring,
                            out + TENSION * task->samples + at, out + ANGLE * task->samples + at,
                            out + REFERENCE * task->samples + at,
                            out + CURRENT * task->samples + at);
        if (left) reduce(task, b, blocks, out, left);
      }
      b = blocks;
      at += task->record_samples[r];
      w += task->windows[r];
    }
    for (r = 0; left && r < task->kept; r++)
      task->residuals[m * task->kept + r] = left[task->chosen[r]];
  }
  free(scratch);
  free(left);
  free(ring.drives);
  return failed;
}
