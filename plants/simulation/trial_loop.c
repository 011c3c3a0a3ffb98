/* The closed-loop trial: a loop around the generated functions estune_prepare, estune_sense and
 * estune_substep. The compiled file has them before this text, with the sizes CONSTANTS, STATES,
 * SUBSTEPS, PIDF_STATES and COEFFICIENTS; COMPENSATED is 1 for trials with compensations, OUTSIDE 1
 * for a plant with a gauge outside, else 0.
 *
 * The dead time is a ring buffer of past drives. During sample k the plant is driven by
 * drive[k - delay - 1] for the dead time's fraction of a sample, then by drive[k - delay].
 *
 * A load is added to the effort on its way to the plant; a null pointer is no load.
 *
 * With `open` equal to one the setpoint is the effort, limited by the controller's limits.
 *
 * Compensations are the text of the hardware loop. They need what the gauge and the encoder read, so
 * that a sample with them is sensed twice: first for the readings, then with what is fed forward and
 * taken off the gauge. The trial begins at rest with them: the controller has the rest of the effort.
 */
#include <math.h>
#include <stdlib.h>
#include <string.h>

enum { VELOCITY, GRAVITY, FRICTION, INERTIA, MAP, NOTCH, EYELET, LIMIT, TERMS };
typedef void (*compensate_function)(void *state, double time, double tension, double angle,
                                    double setpoint, double far_end, double *terms);

/* An unrolled copy is free: the values stay in registers. */
#define UNROLLED _Pragma("GCC unroll 128")

static long one_trial(long samples, long delay, double bound, double preload, double open,
                      const double *parameters, const double *coefficients,
                      const double *setpoint, const double *load, const double *noise, double *ring,
                      double *tension, double *effort, double *angle, double *reference,
                      unsigned char *flags, compensate_function compensate, void *compensation,
                      double period, double *terms) {
  /* CasADi may write outputs before it has read all inputs: they must not share memory. */
  double constants[CONSTANTS], state[STATES], moved[STATES], pidf[PIDF_STATES];
  double following[PIDF_STATES], drive, excess, forward, off, limit;
  long i, k, n, sensed, now = delay + 1, before = 0, after = 1;
  {
    const double *arg[2];
    double *res[4];
    arg[0] = parameters; arg[1] = &preload;
    res[0] = constants; res[1] = state; res[2] = pidf; res[3] = &drive;
    estune_prepare(arg, res, 0, 0, 0);
  }
  for (n = 0; n < delay + 2; n++) ring[n] = drive;
  for (k = 0; k < samples; k++) {
    {
      const double *arg[12];
      double *res[8];
      arg[0] = constants; arg[1] = state; arg[2] = ring + before;
      arg[3] = noise ? noise + k : 0;  /* CasADi reads a null pointer as zero */
      arg[4] = coefficients; arg[5] = pidf; arg[6] = setpoint + k; arg[7] = &open;
      arg[8] = load ? load + k : 0;
      arg[9] = arg[10] = arg[11] = 0;
      res[0] = moved; res[1] = tension + k; res[2] = angle + k;
      res[3] = following; res[4] = effort + k; res[5] = ring + now; res[6] = &excess;
      res[7] = reference ? reference + k : 0;  /* a null pointer: not written */
      /* One call in the text: the compiler expands it in place. */
      for (sensed = 0;; sensed = 1) {
        estune_sense(arg, res, 0, 0, 0);
        if (!COMPENSATED || sensed) break;
        compensate(compensation, k * period, tension[k], angle[k],
                   open ? NAN : pidf[FILTERED_SETPOINT], 0.0, terms);
        if (open) memset(terms + GRAVITY, 0, (TERMS - GRAVITY) * sizeof *terms);
        forward = terms[FRICTION] + terms[INERTIA] + terms[MAP];
        off = terms[GRAVITY] + terms[NOTCH] + terms[EYELET];
        limit = terms[LIMIT];
        terms += TERMS;
        if (k == 0) pidf[INTEGRAL] -= forward;
        arg[9] = &forward; arg[10] = &off; arg[11] = &limit;
      }
    }
    /* This form also ends the trial on NaN. */
    if (!(tension[k] <= bound && tension[k] >= -bound)) return k;
    flags[k] = excess != 0.0;
    UNROLLED
    for (i = 0; i < PIDF_STATES; i++) pidf[i] = following[i];
    UNROLLED
    for (i = 0; i < STATES; i++) state[i] = moved[i];
    for (n = 0; n < SUBSTEPS; n++) {
      const double *arg[5];
      double *res[1], place = n;
      arg[0] = constants; arg[1] = state; arg[2] = ring + before; arg[3] = ring + after;
      arg[4] = &place;
      res[0] = moved;
      estune_substep(arg, res, 0, 0, 0);
      UNROLLED
      for (i = 0; i < STATES; i++) state[i] = moved[i];
    }
    before = after;
    if (++after == delay + 2) after = 0;
    if (++now == delay + 2) now = 0;
  }
  return samples;
}

/* Whether the plant has a gauge outside. */
__attribute__((visibility("default"))) const int estune_outside = OUTSIDE;

/* Runs a batch of trials, one after the other; the arrays of a trial follow each other. A stride
 * of zero shares the parameters or the noise among all trials. Returns nonzero without memory. */
__attribute__((visibility("default"))) int estune_trials(
    long trials, long samples, long delay, double bound, double preload, double open,
    const double *parameters, long parameter_stride, const double *coefficients,
    const double *setpoint, const double *load, const double *noise, long noise_stride,
    double *tension, double *effort, double *angle, double *reference, unsigned char *flags,
    long long *ended, void *compensate, long compensation_size, double period, double *terms) {
  double *ring = malloc((delay + 2) * sizeof *ring);
  void *compensation = malloc(compensation_size + 1);
  long t;
  if (!ring || !compensation) return 1;
  for (t = 0; t < trials; t++) {
    memset(compensation, 0, compensation_size);
    ended[t] = one_trial(samples, delay, bound, preload, open, parameters + t * parameter_stride,
                         coefficients + t * COEFFICIENTS, setpoint, load,
                         noise ? noise + t * noise_stride : 0, ring, tension + t * samples,
                         effort + t * samples, angle + t * samples,
                         reference ? reference + t * samples : 0, flags + t * samples,
                         (compensate_function)compensate, compensation, period,
                         terms ? terms + TERMS * t * samples : 0);
  }
  free(compensation);
  free(ring);
  return 0;
}
