/* A position-controlled drive in SI units of its motor's angle, or of a stage's position.
 *
 *   J1 w1' = i - c - f1(w1) - cogging(q1) + disturbance,     J2 w2' = c - gravity(q2) - f2(w2)
 *
 * c is what a coupling with play passes on by its stiffness and damping; a rigid coupling makes one
 * inertia of both, whose gear rubs in proportion to |c|. f is viscous friction, linear and quadratic
 * and of another size each way, and bristles of the LuGre model (Canudas de Wit et al. 1995), which
 * are on the far side where there is play, as of a table on its guide. The current loop has a dead time and a
 * lag. Semi-implicit Euler steps; the controller and the log run at the sampling rate.
 */
#include <math.h>

#define PARAMETERS \
  X(inertia) X(load_inertia) X(viscous) X(quadratic) X(one_way) X(dry) X(dry_excess) X(stribeck_speed) \
  X(bristle) X(bristle_damping) X(load_viscous) X(gear_share) X(gravity) X(gravity_angle) X(ripple1) X(order1) X(phase1) \
  X(ripple2) X(order2) X(phase2) X(play) X(stiffness) X(damping) X(limit) X(dead_time) X(lag) \
  X(warming) X(warming_s) X(knock) X(kp) X(kd) X(ki) X(start) X(start_speed) X(slow)

enum {
#define X(name) name,
  PARAMETERS
#undef X
  COUNT
};

__attribute__((visibility("default"))) const char *machine_parameters(void) {
#define X(name) #name " "
  return PARAMETERS;
#undef X
}

#define DELAYS 8192

static double sign(double x, double width) { return tanh(x / width); }

/* reference, disturbance, noise of the reading: one value per sample. Fills command and position.
 * step: s, of which a sample has so many substeps. */
__attribute__((visibility("default"))) void drive_run(
    const double *p, long samples, long substeps, double step, const double *reference,
    const double *disturbance, const double *reading_noise,
    double *command, double *position) {
  double q = p[start], w = p[start_speed], q2 = q, w2 = w, z = 0, i = 0, sum = 0, last = q;
  double line[DELAYS] = {0}, tail = 0, sample_s = substeps * step;
  long head = 0, late = (long)(p[dead_time] / step + 0.5);
  int split = p[stiffness] > 0;
  double J = p[inertia] + (split ? 0 : p[load_inertia]);
  for (long k = 0; k < samples; k++) {
    double read = q + reading_noise[k], e = reference[k] - read;
    double rate = (k ? reference[k] - reference[k - 1] : 0) / sample_s;
    sum += p[ki] * e * sample_s;
    double u = p[kp] * e + sum + p[kd] * (rate - (read - last) / sample_s);
    if (k == 0) u = p[kp] * e;
    last = read;
    command[k] = u;
    position[k] = read;
    for (long n = 0; n < substeps; n++) {
      double t = k * sample_s + n * step;
      line[head] = u;
      tail = line[(head + DELAYS - late) % DELAYS];
      head = (head + 1) % DELAYS;
      double wanted = p[limit] > 0 ? fmax(-p[limit], fmin(p[limit], tail)) : tail;
      i = p[lag] > 0 ? i + step / p[lag] * (wanted - i) : wanted;
      double speed = p[play] > 0 ? w2 : w, dry_f = 0;
      double f = p[viscous] * w + 0.5 * p[one_way] * fabs(w) + p[quadratic] * w * fabs(w);
      double level = p[dry] * (1 + p[warming] * (1 - exp(-t / p[warming_s])));
      if (level > 0) {
        double s0 = level / p[bristle], s1 = p[bristle_damping] * sqrt(s0 * J);
        double g = level + p[dry_excess] * exp(-pow(speed / p[stribeck_speed], 2));
        /* Implicit in the bristle, which is stiff at speed. */
        double zn = (z + step * speed) / (1 + step * s0 * fabs(speed) / g);
        dry_f = s0 * zn + s1 * (zn - z) / step;
        z = zn;
      }
      double cog = p[ripple1] * sin(p[order1] * q + p[phase1]) + p[ripple2] * sin(p[order2] * q + p[phase2]);
      double d = disturbance[k] + (p[knock] > 0 && fmod(t, 1.7) < 0.02 ? p[knock] : 0);
      if (!split) {
        double hang = p[gravity] * sin(q + p[gravity_angle]);
        /* What the teeth carry moves the load and holds it up. */
        f += p[load_viscous] * w + dry_f;
        double carried = (i - f) * p[load_inertia] / J + hang * p[inertia] / J;
        double rub = p[gear_share] * fabs(carried) * sign(w, p[slow]);
        w += step / J * (i - f - cog - hang - rub + d);
        q += step * w;
      } else {
        double gap = q - q2, rate_of = w - w2, open = p[play] / 2, c = 0;
        if (fabs(gap) > open || p[play] == 0) {
          c = p[stiffness] * (gap - copysign(open, gap)) + p[damping] * rate_of;
          if (p[play] > 0 && c * gap < 0) c = 0; /* teeth only push */
        }
        double f2 = p[load_viscous] * w2 + (p[play] > 0 ? dry_f : 0);
        f += p[play] > 0 ? 0 : dry_f;
        w += step / p[inertia] * (i - f - cog - c + d);
        w2 += step / p[load_inertia] * (c - f2 - p[gravity] * sin(q2 + p[gravity_angle]));
        q += step * w;
        q2 += step * w2;
      }
    }
  }
}
