/* Compensations beside the PIDF controller: friction (10) as feed-forward along the known motion,
 * that of the eyelet likewise, velocity and acceleration by adaptive windows, inertia as
 * feed-forward, a map over the drum's angle, the cable's weight (9), notches in the measurement, the
 * drive's current limit for the anti-windup, and the current's calibration C1.
 *
 *     static estune_compensation reel;                    all zero at the start
 *     estune_compensation_sample(&reel, time_s, gauge_N, angle_rad, estune_pidf_setpoint(&pidf),
 *                                far_end_m_s);
 *     effort = estune_pidf_step_beside(&pidf, estune_compensation_forward(&reel), reel.limit,
 *                                      setpoint, gauge_N - estune_compensation_off(&reel), &excess);
 *     counts = estune_current_counts(effort / ESTUNE_NEWTONS_PER_AMPERE);
 *
 * The setpoint is the filtered one of the last step, N, and NAN where the loop was open; the far
 * end's commanded velocity counts away from the reel, 0 where nothing is commanded.
 *
 * C99, in double precision (times need it), no allocation, no library but math. A compensation that
 * is not a number is zero; all that is fed forward stays within ESTUNE_FEED_FORWARD_MAX.
 */
#include <math.h>
#include <string.h>

#ifndef ESTUNE_COMPENSATION_EXPORT
#define ESTUNE_COMPENSATION_EXPORT static inline
#endif

typedef struct {
  int filled, direction;
  /* Newest first. */
  double times[ESTUNE_HISTORY], angles[ESTUNE_HISTORY], half_bands[ESTUNE_HISTORY];
  double middles[ESTUNE_HISTORY], velocities[ESTUNE_HISTORY], bounds[ESTUNE_HISTORY];
  double velocity, velocity_bound, acceleration; /* of the drum, rad/s and rad/s2 */
  double gravity, friction, inertia, map, notch; /* N */
  double eyelet, limit;                          /* N; a limit of zero is none */
  double far_end, far_acceleration;              /* of the far end, m/s and m/s2 */
  long unchanged, interval;                      /* samples since it changed, and before that */
  int closed;                                    /* whether the next is a setpoint */
  double setpoint, sliding[2], passing;          /* of the last sample; N, directions -1 to 1 */
  int filtering;                                 /* whether the notches have begun */
  double in[ESTUNE_NOTCHES][2], out[ESTUNE_NOTCHES][2]; /* of the notches, newest first; N */
} estune_compensation;

static void estune_prepend(double *values, double value) {
  memmove(values + 1, values, (ESTUNE_HISTORY - 1) * sizeof *values);
  values[0] = value;
}

/* Slope of the longest chord from the newest sample within the errors of all, its bound, its span. */
static double estune_longest_chord(const double *times, const double *values, const double *errors,
                                   int filled, int intervals, double *bound, double *length) {
  double slope = 0.0, least = -HUGE_VAL, greatest = HUGE_VAL, span, candidate, error;
  int n;
  *bound = HUGE_VAL;
  *length = 0.0;
  for (n = 1; n <= intervals && n < filled; n++) {
    span = times[0] - times[n];
    if (!(span > 0.0)) continue;
    candidate = (values[0] - values[n]) / span;
    if (!(least <= candidate && candidate <= greatest)) break;
    error = errors[0] + errors[n];
    if (error / span < *bound) {
      slope = candidate;
      *bound = error / span;
      *length = span;
    }
    if (candidate - error / span > least) least = candidate - error / span;
    if (candidate + error / span < greatest) greatest = candidate + error / span;
  }
  return slope;
}

static void estune_motion(estune_compensation *c, double time, double angle) {
  double span, raw, floor_, size;
  int direction;
  if (!isfinite(time) || !isfinite(angle) || (c->filled && !(time > c->times[0]))) {
    c->filled = c->direction = 0; /* begin anew with the next sample that is in order */
    c->velocity = c->acceleration = 0.0;
    c->velocity_bound = HUGE_VAL;
    return;
  }
  if (c->filled < ESTUNE_HISTORY) c->filled++;
  estune_prepend(c->times, time);
  estune_prepend(c->angles, angle);
  estune_prepend(c->half_bands, ESTUNE_HALF_BAND);
  c->velocity = estune_longest_chord(c->times, c->angles, c->half_bands, c->filled,
                                     ESTUNE_VELOCITY_INTERVALS, &c->velocity_bound, &span);
  estune_prepend(c->middles, time - 0.5 * span);
  estune_prepend(c->velocities, c->velocity);
  estune_prepend(c->bounds, c->velocity_bound);
  raw = estune_longest_chord(c->middles, c->velocities, c->bounds, c->filled,
                             ESTUNE_ACCELERATION_INTERVALS, &floor_, &span);
  direction = (raw > 0.0) - (raw < 0.0);
  size = fabs(raw);
  if (size >= ESTUNE_STRONG * floor_ || (direction == c->direction && size >= ESTUNE_WEAK * floor_)) {
    c->direction = direction;
    c->acceleration = raw;
  } else {
    c->direction = 0;
    c->acceleration = 0.0;
  }
}

/* (9) with the limit of (8); the length is held within its range. */
static double estune_gravity(double tension, double angle) {
  double length = ESTUNE_LENGTH - ESTUNE_DRUM_RADIUS * angle, weight, vertical;
  if (!isfinite(tension) || !isfinite(angle)) return 0.0;
  length = fmin(fmax(length, ESTUNE_LENGTH_MIN), ESTUNE_LENGTH_MAX);
  weight = ESTUNE_WEIGHT * length;
  if (!(tension > 0.0)) return weight;
  vertical = ESTUNE_RISE / length * (tension + 0.5 * ESTUNE_WEIGHT * ESTUNE_RISE) - 0.5 * weight;
  return -(fmin(fmax(vertical, -tension), tension) / tension) * weight;
}

/* The known motion of a sample, that of the filtered setpoint and of the far end, rad; NAN where the
 * loop was open. */
static double estune_known_move(estune_compensation *c, double setpoint, double far_end) {
  double moved = (setpoint - c->setpoint) / ESTUNE_TENSION_PER_RAD -
                 far_end * ESTUNE_PERIOD / ESTUNE_DRUM_RADIUS;
  int known = c->closed && isfinite(moved);
  c->closed = isfinite(setpoint);
  c->setpoint = setpoint;
  return known ? moved : NAN;
}

/* Direction of sliding, -1 to 1, after a motion; zero after one that is not known. */
static double estune_slid(double direction, double moved, double memory) {
  double sign = moved > 0.0 ? 1.0 : -1.0;
  if (isnan(moved)) return 0.0;
  return moved == 0.0 ? direction : sign + (direction - sign) * exp(-fabs(moved) / memory);
}

static double estune_friction(estune_compensation *c, double setpoint, double moved) {
  double ratio = moved / ESTUNE_PERIOD / ESTUNE_STRIBECK, size;
  c->sliding[0] = estune_slid(c->sliding[0], moved, ESTUNE_MEMORY);
  c->sliding[1] = estune_slid(c->sliding[1], moved, ESTUNE_MEMORY / ESTUNE_SPREAD);
  size = ESTUNE_COULOMB + (ESTUNE_STATIC - ESTUNE_COULOMB) * exp(-(ratio * ratio));
  return ESTUNE_FRACTION * 0.5 * (c->sliding[0] + c->sliding[1]) *
         (size / ESTUNE_DRUM_RADIUS + ESTUNE_LOAD_SHARE * fmax(setpoint, 0.0));
}

/* What the gauge reads more than there is outside the eyelet. */
static double estune_eyelet(estune_compensation *c, double setpoint, double moved) {
  c->passing = estune_slid(c->passing, moved, ESTUNE_EYELET_MEMORY);
  return fmax(setpoint, 0.0) * expm1(ESTUNE_EYELET_EXPONENT * c->passing);
}

/* Inertia and viscous friction along the far end's motion. Its acceleration is the change of the
 * velocity over the samples since the change before, in force for twice as long. */
static double estune_known_motion(estune_compensation *c, double far_end) {
  double drum_per_m = -1.0 / (ESTUNE_DRUM_RADIUS * ESTUNE_DRUM_RADIUS);
  c->unchanged++;
  if (far_end != c->far_end) {
    c->interval = c->unchanged;
    c->far_acceleration = (far_end - c->far_end) / ((double)c->interval * ESTUNE_PERIOD);
    c->far_end = far_end;
    c->unchanged = 0;
  } else if (c->unchanged > 2 * c->interval) {
    c->far_acceleration = 0.0;
  }
  return drum_per_m * (ESTUNE_KNOWN_INERTIA * c->far_acceleration + ESTUNE_KNOWN_VISCOUS * far_end);
}

/* Waves over the drum's angle as it will be when the effort acts: order, N, share of the setpoint,
 * phase. */
static double estune_angle_map(const estune_compensation *c, double angle, double setpoint) {
  static const double waves[][4] = {ESTUNE_WAVES};
  double ahead = angle - ESTUNE_MAP_ZERO + c->velocity * ESTUNE_MAP_LEAD, sum = 0.0;
  int n;
  if (!isfinite(setpoint) || !isfinite(angle)) return 0.0;
  for (n = 0; n < (int)(sizeof waves / sizeof *waves); n++)
    sum += (waves[n][1] + waves[n][2] * fmax(setpoint, 0.0)) *
           sin(waves[n][0] * ahead + waves[n][3]);
  return sum;
}

/* What the notches take off the gauge. They begin at rest, and anew where it is not a number. */
static double estune_notch(estune_compensation *c, double tension) {
  static const double notches[ESTUNE_NOTCHES][5] = {ESTUNE_NOTCH_COEFFICIENTS};
  double x = tension, y;
  int n;
  if (!isfinite(tension)) {
    c->filtering = 0;
    return 0.0;
  }
  for (n = 0; n < ESTUNE_NOTCHES; n++) {
    const double *k = notches[n];
    if (!c->filtering) c->in[n][0] = c->in[n][1] = c->out[n][0] = c->out[n][1] = x;
    y = k[0] * x + k[1] * c->in[n][0] + k[2] * c->in[n][1] - k[3] * c->out[n][0] -
        k[4] * c->out[n][1];
    c->in[n][1] = c->in[n][0];
    c->in[n][0] = x;
    c->out[n][1] = c->out[n][0];
    c->out[n][0] = y;
    x = y;
  }
  c->filtering = 1;
  return tension - x;
}

static double estune_limited(double value) {
  if (isnan(value)) return 0.0;
  return fmin(fmax(value, -ESTUNE_FEED_FORWARD_MAX), ESTUNE_FEED_FORWARD_MAX);
}

/* The compensations of a sample: time in s, tension at the gauge in N, angle of the drum in rad,
 * filtered setpoint of the last step in N, velocity of the far end in m/s. */
ESTUNE_COMPENSATION_EXPORT void estune_compensation_sample(estune_compensation *c, double time,
                                                           double tension, double angle,
                                                           double setpoint, double far_end) {
  double moved = estune_known_move(c, setpoint, far_end);
  estune_motion(c, time, angle);
  c->gravity = estune_gravity(tension, angle);
  c->friction = estune_limited(estune_friction(c, setpoint, moved));
  c->inertia = estune_limited(ESTUNE_INERTIA * c->acceleration / ESTUNE_DRUM_RADIUS +
                              estune_known_motion(c, isfinite(setpoint) ? far_end : 0.0));
  c->inertia = estune_limited(c->friction + c->inertia) - c->friction;
  c->map = estune_limited(c->friction + c->inertia + estune_angle_map(c, angle, setpoint)) -
           (c->friction + c->inertia);
  c->notch = estune_notch(c, tension);
  c->eyelet = estune_limited(estune_eyelet(c, setpoint, moved));
  c->limit = ESTUNE_EFFORT_LIMIT;
}

/* Effort beside that of the controller, N. */
ESTUNE_COMPENSATION_EXPORT double estune_compensation_forward(const estune_compensation *c) {
  return c->friction + c->inertia + c->map;
}

/* What the controlled tension is less than that at the gauge, N. */
ESTUNE_COMPENSATION_EXPORT double estune_compensation_off(const estune_compensation *c) {
  return c->gravity + c->notch + c->eyelet;
}

/* Command of the current controller, counts, by Newton's method on its calibrated curve C1. */
ESTUNE_COMPENSATION_EXPORT double estune_current_counts(double current) {
  static const double curve[] = {ESTUNE_CURRENT_CURVE};
  double low = -ESTUNE_CURRENT_REACH, high = ESTUNE_CURRENT_REACH, u = 0.0, value, slope, next;
  int step, k, settled = 0;
  for (step = 0; step < 20 && !settled; step++) {
    value = slope = 0.0;
    for (k = (int)(sizeof curve / sizeof *curve) - 1; k >= 0; k--) {
      slope = slope * u + value;
      value = value * u + curve[k];
    }
    if ((value > current) == (curve[1] > 0.0)) high = u;
    else low = u;
    next = slope != 0.0 ? u - (value - current) / slope : u;
    if (!(low <= next && next <= high)) next = 0.5 * (low + high);
    settled = fabs(next - u) <= 1e-12 * ESTUNE_CURRENT_REACH;
    u = next;
  }
  return rint(ESTUNE_CURRENT_MIDDLE + ESTUNE_CURRENT_HALF * u);
}
