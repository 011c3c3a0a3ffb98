/* The reel's closed-loop trial in hand-written C: the reference of benchmark_trials.py.
 *
 * The equations of plants/models/reel_equations.py and estune/core/pidf.py, with Coulomb friction
 * and a dead time of whole samples, specialised: constants in locals, zeros of the matrices omitted.
 * It is independent of the generated code.
 */
#include <math.h>

enum { SUBSTEPS = 4, MAX_DELAY = 64 };

struct parameters {
  double length_m, radius_m, inertia, friction, friction_per_m, structure_N_m, EA_N, density,
      torque_constant, current_limit, gauge_Hz, gauge_damping, encoder_counts, sampling_Hz,
      dead_time_s, delay_samples, coulomb_Nm;
};

struct controller {
  double P, I_h, D, pole, span_s, h, tracking, low, high;
};

static double clip(double x, double low, double high) {
  return x < low ? low : x > high ? high : x;
}

/* Psi = int_0^h exp(A s) ds by its Taylor series, row-major 4 x 4. */
static void integral(const double A[4][4], double h, double psi[4][4]) {
  double next[4][4];
  int degree, i, j, k;
  for (i = 0; i < 4; i++)
    for (j = 0; j < 4; j++) psi[i][j] = i == j;
  for (degree = 20; degree > 0; degree--) {
    for (i = 0; i < 4; i++)
      for (j = 0; j < 4; j++) {
        double sum = 0.0;
        for (k = 0; k < 4; k++) sum += A[i][k] * psi[k][j];
        next[i][j] = (i == j) + h / (degree + 1) * sum;
      }
    for (i = 0; i < 4; i++)
      for (j = 0; j < 4; j++) psi[i][j] = next[i][j];
  }
  for (i = 0; i < 4; i++)
    for (j = 0; j < 4; j++) psi[i][j] *= h;
}

long reference_trial(const struct parameters *p, const struct controller *c, double preload,
                     long delay, long samples, double bound, const double *setpoint,
                     const double *noise, double *tension, double *effort, double *angle,
                     unsigned char *flags) {
  const double pi = 3.14159265358979323846;
  const double weight = 9.80665 * p->density, L = p->length_m;
  const double sag = weight * weight * L * L * L / (12.0 * preload * preload * preload);
  const double k = 1.0 / (1.0 / p->structure_N_m + L / p->EA_N + sag);
  const double b = p->friction + p->friction_per_m * L, J = p->inertia, R = p->radius_m;
  const double w = 2.0 * pi * p->gauge_Hz, h = 1.0 / (p->sampling_Hz * SUBSTEPS);
  const double A[4][4] = {{0, 1, 0, 0},
                          {-k * R * R / J, -b / J, 0, 0},
                          {0, 0, 0, 1},
                          {w * w * k * R, 0, -w * w, -2.0 * p->gauge_damping * w}};
  double psi[4][4], Phi[4][4], torque[4], slack[4], drive[MAX_DELAY + 1];
  long i, j, m, n, now;

  integral(A, h, psi);
  for (i = 0; i < 4; i++) {
    for (j = 0; j < 4; j++) {
      double sum = i == j;
      for (m = 0; m < 4; m++) sum += A[i][m] * psi[m][j];
      Phi[i][j] = sum;
    }
    torque[i] = psi[i][1] / J;
    slack[i] = -psi[i][1] * R / J + psi[i][3] * w * w;
  }

  const double f00 = Phi[0][0], f01 = Phi[0][1], f10 = Phi[1][0], f11 = Phi[1][1];
  const double f20 = Phi[2][0], f21 = Phi[2][1], f22 = Phi[2][2], f23 = Phi[2][3];
  const double f30 = Phi[3][0], f31 = Phi[3][1], f32 = Phi[3][2], f33 = Phi[3][3];
  const double t0 = torque[0], t1 = torque[1], t2 = torque[2], t3 = torque[3];
  const double s0 = slack[0], s1 = slack[1], s2 = slack[2], s3 = slack[3];
  const double Kt = p->torque_constant, per_newton = R / Kt, limit = p->current_limit;
  const double F = p->coulomb_Nm, stop = 1.0 / t1, kR = k * R, half = 0.5 * h;
  const double count = 2.0 * pi / p->encoder_counts, per_count = 1.0 / count;

  double theta = preload / kR, omega = 0.0, g = preload, rate = 0.0;
  double I = preload, rf = preload, yf = preload;
  for (i = 0; i <= delay; i++) drive[i] = preload * per_newton;
  now = delay;

  for (n = 0; n < samples; n++) {
    const double y = g + noise[n];
    tension[n] = y;
    angle[n] = floor(theta * per_count + 0.5) * count;

    rf = c->pole * rf + (1.0 - c->pole) * setpoint[n];
    const double e = rf - y, dy = (y - yf) / c->span_s;
    const double wanted = c->P * e + I - c->D * dy, u = clip(wanted, c->low, c->high);
    I += c->I_h * e - c->tracking * (wanted - u);
    yf += c->h * dy;
    effort[n] = u;
    if (!(fabs(y) <= bound)) return n;
    flags[n] = wanted != u;

    drive[now] = clip(u * per_newton, -limit, limit);
    if (++now > delay) now = 0;
    const double tau = Kt * drive[now];
    const double d0 = t0 * tau, d1 = t1 * tau, d2 = t2 * tau, d3 = t3 * tau;

    for (m = 0; m < SUBSTEPS; m++) {
      const double linear = kR * (theta + half * omega);
      const double extra = linear > 0.0 ? 0.0 : -linear;
      const double free0 = f00 * theta + f01 * omega + d0 + s0 * extra;
      const double free1 = f10 * theta + f11 * omega + d1 + s1 * extra;
      const double free2 = f20 * theta + f21 * omega + f22 * g + f23 * rate + d2 + s2 * extra;
      const double free3 = f30 * theta + f31 * omega + f32 * g + f33 * rate + d3 + s3 * extra;
      const double friction = clip(-free1 * stop, -F, F);
      theta = free0 + t0 * friction;
      omega = free1 + t1 * friction;
      g = free2 + t2 * friction;
      rate = free3 + t3 * friction;
    }
  }
  return samples;
}
