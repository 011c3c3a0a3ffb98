/* A cable machine whose cable end is fixed, in forces at the drum's rim and metres of cable travel.
 *
 *   M v' = f - c v - c1 max(v, 0) - c2 v|v| - T arm(x) - dry - ripple + disturbance
 *
 * All of it, with the drive's current loop, the bristles of dry friction, the slow branches of the
 * cable, the string, the frame and the gauge, is one set of differential equations, integrated by
 * the classical Runge-Kutta method of fourth order. What has memory without a time scale (the
 * cable's slip through the eyelet, the slip elements) is mapped back to its limits at each stage
 * from where the last substep left it.
 */
#include <math.h>
#include <string.h>

#define PARAMETERS \
  X(mass) X(drag) X(drag2) X(drag_one_way) X(gain) X(push) X(lag) X(delay) \
  X(chain) X(stiffness) X(sag) X(stiffening) X(stiffening_at) X(stiffening_power) X(toe) X(toe_width) \
  X(slow1) X(slow1_s) X(slow2) X(slow2_s) \
  X(hold) X(inner) X(string_mass) X(string_length) X(string_damping) \
  X(frame_mass) X(frame_stiffness) X(frame_damping) X(frame_hardening) \
  X(dry) X(dry_load) X(dry_excess) X(dry_velocity) X(dry_bias) X(bristle) X(bristle_damping) \
  X(slip_force) X(slip_length) X(bend_force) X(bend_length) X(bend_power) X(rub_force) X(rub_at) X(rub_width) \
  X(ripple1) X(ripple2) X(ripple_wave) X(ripple_phase1) X(ripple_phase2) \
  X(radius) X(round1) X(round1_phase) X(round2) X(round2_phase) \
  X(play) X(play_stiffness) X(play_damping) X(far_mass) X(far_drag) X(far_dry) \
  X(limit) X(limit_power) X(slew) X(slew_soft) X(dead_band) X(lag_slow) X(lag_size) \
  X(heat) X(heat_s) X(loop_force) X(loop_length) \
  X(gauge_rate) X(gauge_damping) X(mode_share) X(mode_rate) X(mode_damping) \
  X(gauge_loop) X(gauge_loop_width) X(gauge_bend) X(gauge_bend_more) X(gauge_acceleration) X(gauge_current) \
  X(gauge_step) X(encoder_step) X(encoder_zero) X(unloaded) \
  X(control) X(P) X(I) X(D) X(filter) X(D_filter) X(command_limit)

enum {
#define X(name) name,
  PARAMETERS
#undef X
  COUNT
};

enum { TRAVEL, SPEED, FORCE, READ, READ_RATE, BRISTLE, SLOW1, SLOW2, SAG, SAG_RATE, FRAME,
       FRAME_RATE, MODE, MODE_RATE, FAR, FAR_SPEED, FAR_BRISTLE, WARMTH, LOOP, GAUGE_LOOP, BEND,
       CHAIN1, CHAIN2, CHAIN3, STATES };
#define SLIPS 6
/* State, memory (slip through the eyelet, slip elements, tension), then the controller's numbers. */
enum { INTEGRAL = STATES + SLIPS + 2, FILTERED_SETPOINT, FILTERED_READING, LAST_COMMAND, NUMBERS };
#define DELAYS 4096
#define PI 3.14159265358979323846
#define GRAVITY 9.81

/* What is remembered without a time scale, and the last tension, from which roots are sought. */
typedef struct { double through, slip[SLIPS], tension; } Memory;
typedef struct { double inside, outside, through; } Cable;

/* Tension of the stretched cable. e: stretch beyond just taut. */
static double elastic(const double *p, double e, double k, double *slope) {
  if (p[toe] > 0) {
    double s = (e - p[toe]) / p[toe_width];
    *slope = k / (1 + exp(-s));
    return s > 40 ? k * (e - p[toe]) : k * p[toe_width] * log1p(exp(s));
  }
  if (p[stiffening] > 0 && e > 0) {
    double more = p[stiffening] * pow(e / p[stiffening_at], p[stiffening_power]);
    *slope = k * (1 + (1 + p[stiffening_power]) * more);
    return k * e * (1 + more);
  }
  if (e <= 0) { *slope = 0; return 0; }
  *slope = k;
  return k * e;
}

/* The same with the sag, which takes up length as the tension rises, and the slow branches. */
static double outer(const double *p, const double *y, double e, double k, double guess,
                    double *slope) {
  double T, s, rest = 0, stiff = 0;
  int n;
  if (p[slow1] > 0) { rest += k * p[slow1] * (e - y[SLOW1]); stiff += k * p[slow1]; }
  if (p[slow2] > 0) { rest += k * p[slow2] * (e - y[SLOW2]); stiff += k * p[slow2]; }
  if (p[string_mass] > 0) {
    double L = p[string_length];
    T = elastic(p, e + PI * PI * y[SAG] * y[SAG] / (4 * L), k, &s) + rest;
    *slope = s + stiff;
    return T > 0 ? T : 0;
  }
  if (p[sag] <= 0) {
    T = elastic(p, e, k, &s) + rest;
    *slope = s + stiff;
    return T > 0 ? T : 0;
  }
  T = guess > 1e-3 ? guess : 1e-3;
  for (n = 0; n < 40; n++) {
    double taken = p[sag] / (T * T), f = elastic(p, e + taken, k, &s) + rest - T, next;
    next = T + f / (1 + s * 2 * taken / T);
    if (!(next > 0.3 * T)) next = 0.3 * T;
    if (fabs(next - T) < 1e-12 + 1e-11 * T) { T = next; break; }
    T = next;
    if (T < 1e-4) { T = 1e-4; break; }
  }
  *slope = (s + stiff) / (1 + s * 2 * p[sag] / (T * T * T));
  return T;
}

/* Both tensions beside the eyelet; in it the cable slips where their ratio passes the capstan's. */
static Cable cable(const double *p, const double *y, const Memory *m, double e) {
  Cable c = {0, 0, e};
  double slope, k1, k2, ratio, s;
  int n;
  if (p[hold] >= 1) {
    c.inside = c.outside = outer(p, y, e, p[stiffness], m->tension, &slope);
    return c;
  }
  k2 = p[stiffness] / p[inner];
  k1 = p[stiffness] / (1 - p[inner]);
  s = m->through;
  c.outside = outer(p, y, s, k1, m->tension, &slope);
  c.inside = k2 * (e - s);
  if (c.inside > c.outside / p[hold]) ratio = 1 / p[hold];
  else if (c.inside < c.outside * p[hold]) ratio = p[hold];
  else { c.through = s; return c; }
  for (n = 0; n < 60; n++) {
    double next;
    c.outside = outer(p, y, s, k1, m->tension, &slope);
    next = s + (k2 * (e - s) - ratio * c.outside) / (k2 + ratio * slope);
    if (fabs(next - s) < 1e-14) break;
    s = next;
  }
  c.through = s;
  c.inside = k2 * (e - s);
  if (c.inside < 0) c.inside = 0;
  return c;
}

static double slid(const double *p, const Memory *m, double x, double *slip) {
  double total = 0;
  int n;
  for (n = 0; n < SLIPS; n++) {
    /* Elements of equal strength give way one after the other. */
    double reach = p[slip_length] * (n + 0.5) * (n + 0.5) / (SLIPS * 0.5 * SLIPS);
    double bent = x - m->slip[n];
    if (bent > reach) bent = reach;
    if (bent < -reach) bent = -reach;
    if (slip) slip[n] = x - bent;
    total += p[slip_force] / SLIPS * bent / reach;
  }
  return total;
}

/* Dry friction of bristles (Canudas de Wit 1995). */
static double dry_force(double size, double excess, double velocity, double reach, double damping,
                        double mass_, double v, double z, double *z_rate) {
  double k = size / reach, g = size + excess * exp(-v * v / (velocity * velocity));
  double d = damping * sqrt(k * mass_) / (1 + v * v * 1e6);
  *z_rate = v - k * fabs(v) * z / g;
  return k * z + d * *z_rate;
}

static double sign(double v) { return (v > 0) - (v < 0); }

static void rates(const double *p, const Memory *m, const double *y, double command,
                  double disturbance, double *r) {
  double x = y[TRAVEL], v = y[SPEED], f = y[FORCE], T = 0, wound = x, arm = 1, force;
  double drum = x, drum_speed = v;
  Cable c = {0, 0, 0};
  memset(r, 0, STATES * sizeof *r);
  r[TRAVEL] = v;
  /* Drive: electronics that are late without being idle, current loop, slew, then what heat leaves of the force. */
  if (p[chain] > 0) {
    double rate = 3 / p[chain];
    r[CHAIN1] = rate * (command - y[CHAIN1]);
    r[CHAIN2] = rate * (y[CHAIN1] - y[CHAIN2]);
    r[CHAIN3] = rate * (y[CHAIN2] - y[CHAIN3]);
    command = y[CHAIN3];
  }
  if (p[slew] > 0) r[FORCE] = p[slew] * tanh((command - f) / (p[slew] * p[slew_soft]));
  else if (p[lag_slow] > 0)
    r[FORCE] = (command - f) / (p[lag] + p[lag_slow] * fabs(command - f) /
                                             (p[lag_size] + fabs(command - f)));
  else r[FORCE] = (command - f) / p[lag];
  r[WARMTH] = p[heat] > 0 ? (p[heat] * f * f - y[WARMTH]) / p[heat_s] : 0;
  force = (p[gain] * f) / (1 + y[WARMTH]) + p[push] + disturbance;
  /* Cable. */
  if (p[far_mass] > 0) { drum = y[FAR]; drum_speed = y[FAR_SPEED]; }
  if (!p[unloaded]) {
    double q = p[frame_mass] > 0 ? y[FRAME] : 0, rate;
    wound = drum;
    if (p[round1] > 0) {
      double a = drum / p[radius], R = p[radius];
      wound += R * p[round1] * (sin(a + p[round1_phase]) - sin(p[round1_phase])) +
               0.5 * R * p[round2] * (sin(2 * a + p[round2_phase]) - sin(p[round2_phase]));
      arm += p[round1] * cos(a + p[round1_phase]) + p[round2] * cos(2 * a + p[round2_phase]);
    }
    c = cable(p, y, m, wound - q);
    T = c.inside;
    rate = drum_speed * arm - (p[frame_mass] > 0 ? y[FRAME_RATE] : 0);
    if (p[loop_force] > 0) {
      r[LOOP] = (rate - fabs(rate) * y[LOOP] * fabs(y[LOOP])) / p[loop_length];
      T += p[loop_force] * y[LOOP];
      if (T < 0) T = 0;
    }
    if (p[slow1] > 0) r[SLOW1] = (c.through - y[SLOW1]) / p[slow1_s];
    if (p[slow2] > 0) r[SLOW2] = (c.through - y[SLOW2]) / p[slow2_s];
    if (p[string_mass] > 0) {
      double w2 = c.outside / p[string_mass] * PI * PI / (p[string_length] * p[string_length]);
      r[SAG] = y[SAG_RATE];
      r[SAG_RATE] = 4 * GRAVITY / PI - w2 * y[SAG] - 2 * p[string_damping] * sqrt(w2) * y[SAG_RATE];
    }
    if (p[frame_mass] > 0) {
      double k = p[frame_stiffness] * (1 + p[frame_hardening] * q * q);
      r[FRAME] = y[FRAME_RATE];
      r[FRAME_RATE] = (T - k * q - p[frame_damping] * y[FRAME_RATE]) / p[frame_mass];
    }
  }
  /* Motor and drum. */
  force -= p[drag] * v + p[drag2] * v * fabs(v);
  /* The change from one direction to the other takes a millimetre per second. */
  if (p[drag_one_way] != 0)
    force -= fabs(p[drag_one_way]) * v * 0.5 * (1 + sign(p[drag_one_way]) * tanh(v * 1e3));
  if (p[dry] > 0 || p[dry_load] > 0) {
    force -= dry_force(p[dry] + p[dry_load] * T + 1e-9, p[dry_excess], p[dry_velocity], p[bristle], p[bristle_damping],
                       p[mass], v, y[BRISTLE], &r[BRISTLE]) * (1 + p[dry_bias] * sign(v));
  }
  if (p[slip_force] > 0) force -= slid(p, m, x, 0);
  if (p[bend_force] > 0) {
    double left = 1 - sign(v) * y[BEND];
    r[BEND] = v / p[bend_length] * sign(left) * pow(fabs(left), p[bend_power]);
    force -= p[bend_force] * y[BEND];
  }
  if (p[rub_force] > 0)
    force -= p[rub_force] * tanh(v * 1e3) / (1 + exp(-(x - p[rub_at]) / p[rub_width]));
  force -= p[ripple1] * sin(p[ripple_wave] * x + p[ripple_phase1]) +
           p[ripple2] * sin(2 * p[ripple_wave] * x + p[ripple_phase2]);
  if (p[far_mass] > 0) {
    /* Contact of the teeth, oiled, on either side of the play; they press and never pull. */
    double gap = x - y[FAR], h = 0.5 * p[play], pressed, closing = v - y[FAR_SPEED], far;
    pressed = gap > h ? gap - h : gap < -h ? gap + h : 0;
    if (pressed != 0) {
      far = sign(pressed);
      pressed = p[play_stiffness] * pressed + p[play_damping] * closing;
      if (pressed * far < 0) pressed = 0;
    }
    force -= pressed;
    far = pressed - T * arm - p[far_drag] * y[FAR_SPEED];
    if (p[far_dry] > 0)
      far -= dry_force(p[far_dry], 0, 1, p[bristle], p[bristle_damping], p[far_mass],
                       y[FAR_SPEED], y[FAR_BRISTLE], &r[FAR_BRISTLE]);
    r[FAR] = y[FAR_SPEED];
    r[FAR_SPEED] = far / p[far_mass];
  } else {
    force -= T * arm;
  }
  r[SPEED] = force / p[mass];
  /* Gauge. */
  if (!p[unloaded]) {
    double w = p[gauge_rate];
    r[READ] = y[READ_RATE];
    r[READ_RATE] = w * w * (T - y[READ]) - 2 * p[gauge_damping] * w * y[READ_RATE];
    if (p[mode_share] > 0) {
      w = p[mode_rate];
      r[MODE] = y[MODE_RATE];
      r[MODE_RATE] = w * w * (y[READ] - y[MODE]) - 2 * p[mode_damping] * w * y[MODE_RATE];
    }
    if (p[gauge_loop] != 0)
      r[GAUGE_LOOP] = (y[READ_RATE] - fabs(y[READ_RATE]) * y[GAUGE_LOOP]) / p[gauge_loop_width];
  }
}

/* The gauge's reading before noise and converter. */
static double reading(const double *p, const Memory *m, const double *y, double command) {
  double g = y[READ], r[STATES];
  if (p[unloaded]) return 0;
  if (p[mode_share] > 0) g += p[mode_share] * (y[MODE] - y[READ]);
  if (p[gauge_loop] != 0) g += p[gauge_loop] * y[GAUGE_LOOP];
  g += p[gauge_bend] * g * g * (1 + p[gauge_bend_more] * g);
  if (p[gauge_acceleration] != 0) {
    rates(p, m, y, command, 0, r);
    g += p[gauge_acceleration] * r[SPEED];
  }
  return g + p[gauge_current] * y[FORCE];
}

static double limited(const double *p, double u) {
  if (p[dead_band] > 0)
    u = sign(u) * p[dead_band] * (pow(1 + pow(fabs(u) / p[dead_band], 4), 0.25) - 1);
  if (p[limit] > 0) u /= pow(1 + pow(fabs(u) / p[limit], p[limit_power]), 1 / p[limit_power]);
  return u;
}
