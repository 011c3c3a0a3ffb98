/* Records of the machine of equations.h: its controller, its converters, its time steps. */
#include "equations.h"

__attribute__((visibility("default"))) const char *machine_parameters(void) {
#define X(name) #name " "
  return PARAMETERS;
#undef X
}

static double stepped(double value, double step) {
  return step > 0 ? (floor(value / step) + 0.5) * step : value;
}

/* One record. State and memory go in and come out, so that records may follow each other. All
 * columns have a value per sample; `late` is the share of a sample by which it is taken late. */
__attribute__((visibility("default"))) int machine_run(
    const double *p, long samples, double dt, long substeps, const double *setpoint,
    const double *added, const double *scale, const double *disturbance, const double *late,
    double *numbers, double *tension, double *angle, double *command, double *force,
    double *outside) {
  double y[STATES], integral, filtered_r, filtered_y, past[DELAYS], last;
  Memory m;
  long k, n, i, whole = (long)floor(p[delay] / dt);
  double fraction = p[delay] / dt - whole, R = p[radius];
  if (whole + 2 >= DELAYS) return 2;
  memcpy(y, numbers, sizeof y);
  memcpy(&m, numbers + STATES, sizeof m);
  integral = numbers[INTEGRAL];
  filtered_r = numbers[FILTERED_SETPOINT];
  filtered_y = numbers[FILTERED_READING];
  last = numbers[LAST_COMMAND];
  for (k = 0; k < DELAYS; k++) past[k] = last;
  for (k = 0; k < samples; k++) {
    double u, before, after, h, seen, turned;
    long pieces = substeps, at;
    seen = stepped(reading(p, &m, y, past[(k + DELAYS - 1) % DELAYS]) * scale[k] + added[k],
                   p[gauge_step]);
    turned = floor((y[TRAVEL] / R + p[encoder_zero]) / p[encoder_step]) * p[encoder_step];
    if (p[control] == 0) u = setpoint[k];
    else {
      /* Force from an error by a trapezoidal integral; mode 1 on tension, mode 2 on angle. */
      double measured = p[control] == 1 ? seen : turned - p[encoder_zero], slope, error;
      filtered_r += (setpoint[k] - filtered_r) * dt / (p[filter] + dt);
      slope = (measured - filtered_y) / (p[D_filter] + dt);
      filtered_y += dt * slope;
      error = filtered_r - measured;
      u = p[P] * error + integral + 0.5 * dt * p[I] * error - p[D] * slope;
      if (fabs(u) < p[command_limit]) integral += dt * p[I] * error;
      if (u > p[command_limit]) u = p[command_limit];
      if (u < -p[command_limit]) u = -p[command_limit];
    }
    command[k] = u;
    past[k % DELAYS] = limited(p, u);
    before = past[(k - whole - 1 + DELAYS + DELAYS) % DELAYS];
    after = past[(k - whole + DELAYS + DELAYS) % DELAYS];
    /* Bristles settle over their reach; no substep may be longer than that. */
    if (p[dry] > 0 || p[far_dry] > 0) {
      double fast = fabs(y[SPEED]) + 0.5 * fabs(y[FAR_SPEED]);
      long needed = (long)ceil(1.3 * (fast + 2e-3) * dt / p[bristle]);
      if (needed > pieces) pieces = needed < 4000 ? needed : 4000;
    }
    h = dt / pieces;
    at = late[k] > 0 ? (long)(late[k] * pieces) : 0;
    for (n = 0; n < pieces; n++) {
      double r1[STATES], r2[STATES], r3[STATES], r4[STATES], w[STATES], share, drive, pushed;
      Cable c;
      double drum;
      if (n == at) {
        if (late[k] > 0) {
          seen = stepped(reading(p, &m, y, after) * scale[k] + added[k], p[gauge_step]);
          turned = floor((y[TRAVEL] / R + p[encoder_zero]) / p[encoder_step]) * p[encoder_step];
        }
        tension[k] = seen;
        angle[k] = turned;
        force[k] = y[FORCE];
        outside[k] = m.tension;
      }
      share = (n + 1) - fraction * pieces;  /* of this substep that comes after the change */
      share = share < 0 ? 0 : share > 1 ? 1 : share;
      drive = before + share * (after - before);
      pushed = disturbance[k] + (k + 1 < samples ? disturbance[k + 1] - disturbance[k] : 0) *
               (n + 0.5) / pieces;
      rates(p, &m, y, drive, pushed, r1);
      for (i = 0; i < STATES; i++) w[i] = y[i] + 0.5 * h * r1[i];
      rates(p, &m, w, drive, pushed, r2);
      for (i = 0; i < STATES; i++) w[i] = y[i] + 0.5 * h * r2[i];
      rates(p, &m, w, drive, pushed, r3);
      for (i = 0; i < STATES; i++) w[i] = y[i] + h * r3[i];
      rates(p, &m, w, drive, pushed, r4);
      for (i = 0; i < STATES; i++) y[i] += h / 6 * (r1[i] + 2 * r2[i] + 2 * r3[i] + r4[i]);
      if (!isfinite(y[SPEED])) return 1;
      if (p[slip_force] > 0) slid(p, &m, y[TRAVEL], m.slip);
      if (!p[unloaded]) {
        drum = p[far_mass] > 0 ? y[FAR] : y[TRAVEL];
        if (p[round1] > 0) {
          double a = drum / R;
          drum += R * p[round1] * (sin(a + p[round1_phase]) - sin(p[round1_phase])) +
                  0.5 * R * p[round2] * (sin(2 * a + p[round2_phase]) - sin(p[round2_phase]));
        }
        c = cable(p, y, &m, drum - (p[frame_mass] > 0 ? y[FRAME] : 0));
        m.through = c.through;
        m.tension = c.outside;
      }
    }
    last = past[k % DELAYS];
  }
  memcpy(numbers, y, sizeof y);
  memcpy(numbers + STATES, &m, sizeof m);
  numbers[INTEGRAL] = integral;
  numbers[FILTERED_SETPOINT] = filtered_r;
  numbers[FILTERED_READING] = filtered_y;
  numbers[LAST_COMMAND] = last;
  return 0;
}

__attribute__((visibility("default"))) long machine_numbers(void) { return NUMBERS; }

/* All that is remembered, of a machine near its rest at a tension, with a command in force. */
__attribute__((visibility("default"))) void machine_rest(const double *p, double tension,
                                                         double setpoint, double command,
                                                         double *numbers) {
  double *y = numbers, low = -1, high = 10, slope;
  Memory m = {0, {0}, tension};
  int n;
  memset(numbers, 0, NUMBERS * sizeof *numbers);
  y[FORCE] = y[CHAIN1] = y[CHAIN2] = y[CHAIN3] = command;
  y[READ] = y[MODE] = tension;
  if (p[unloaded]) return;
  if (p[string_mass] > 0)
    y[SAG] = 4 * GRAVITY * p[string_mass] * p[string_length] * p[string_length] /
             (PI * PI * PI * tension);
  for (n = 0; n < 80; n++) {
    double e = 0.5 * (low + high);
    y[SLOW1] = y[SLOW2] = e;
    if (outer(p, y, e, p[stiffness], tension, &slope) < tension) low = e;
    else high = e;
  }
  y[TRAVEL] = y[FAR] = high;
  if (p[frame_mass] > 0) y[FRAME] = tension / p[frame_stiffness];
  y[TRAVEL] += y[FRAME];
  y[FAR] += y[FRAME];
  m.through = p[hold] < 1 ? high - tension * p[inner] / p[stiffness] : high;
  y[SLOW1] = y[SLOW2] = m.through;
  for (n = 0; n < SLIPS; n++) m.slip[n] = y[TRAVEL];
  memcpy(numbers + STATES, &m, sizeof m);
  numbers[INTEGRAL] = command;
  numbers[FILTERED_SETPOINT] = setpoint;
  numbers[FILTERED_READING] = p[control] == 2 ? 0 : tension;
  numbers[LAST_COMMAND] = command;
}

__attribute__((visibility("default"))) double machine_warmth(const double *numbers) {
  return numbers[WARMTH];
}

__attribute__((visibility("default"))) void machine_warm(double *numbers, double warmth) {
  numbers[WARMTH] = warmth;
}
