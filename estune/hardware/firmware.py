"""C text of the controller, generated from `estune.core.pidf`; one self-contained file.

The file is compiled for the real-time loop of a rig (`estune.hardware.controller`) and exported
for firmware (`estune export-controller`). It is C90, allocates nothing, keeps no state of its own
and needs no library but `exp`. Firmware without double precision defines `casadi_real` as `float`.
"""

import re
from importlib.metadata import version
from typing import Any

from estune.core import pidf
from estune.core.gains import GAIN_NAMES, Gains
from estune.core.pidf import ControllerSettings

COEFFICIENTS = len(pidf.Coefficients._fields)
STATES = len(pidf.PidfState._fields)

# Around each function CasADi writes a dozen others by which its own virtual machine would find it.
_BODY = re.compile(
    r"^static int casadi_f\d+\([^{]*\{(.*?)  return 0;\n\}", re.DOTALL | re.MULTILINE
)

_TEXT = """\
/* The PIDF controller of a motorised cable reel, (32) to (34), made by estune {software}.
 *
 *     u = P e + I int(e) - D dy/dt,  e = F r - y,  F = 1/(setpoint_filter_s s + 1)
 *
 * Call estune_pidf_step every {period_us:.6g} us ({sampling_Hz:g} Hz) with setpoint and measured
 * tension in N; it returns the effort in N, from {output_min_N:g} to {output_max_N:g} N: divide it
 * by the reel's N/A for the motor current. Derivative filter {derivative_filter_s:g} s.
 *
 *     estune_pidf reel;
 *     estune_pidf_init(&reel);                        the gains below
 *     estune_pidf_at_rest(&reel, tension, effort);    before the first step
 *     effort = estune_pidf_step(&reel, setpoint, tension, &excess);
 *
 * To change gains while the loop runs, without a jump of the effort:
 *
 *     estune_pidf_gains(&reel, P, I, D, setpoint_filter_s);
 *     estune_pidf_take_over(&reel, setpoint, tension, last_effort);    before the next step
 *
 * and where they go on changing, as by a schedule over cable length, at any sample:
 *
 *     estune_pidf_exchange(&reel, P, I, D, setpoint_filter_s, setpoint, tension);
 *
 * Without double precision, define casadi_real as float before this text.
 * A measurement that is not a number must not reach the controller: check it before.
 */
#include <math.h>

#ifndef casadi_real
#define casadi_real double
#endif
#ifndef ESTUNE_PIDF_EXPORT
#define ESTUNE_PIDF_EXPORT
#endif

#define ESTUNE_PIDF_SAMPLING_HZ {sampling_Hz!r}
#define casadi_inf HUGE_VAL

static casadi_real casadi_fmax(casadi_real x, casadi_real y) {{ return x > y ? x : y; }}
static casadi_real casadi_fmin(casadi_real x, casadi_real y) {{ return x < y ? x : y; }}

{generated}
typedef struct {{
  casadi_real coefficients[{coefficients}]; /* {coefficient_names} */
  casadi_real state[{states}];        /* {state_names} */
}} estune_pidf;

/* Sets the gains; see estune_pidf_take_over. */
ESTUNE_PIDF_EXPORT void estune_pidf_gains(estune_pidf *pidf, casadi_real P, casadi_real I,
                                          casadi_real D, casadi_real setpoint_filter_s) {{
  casadi_real gains[4];
  const casadi_real *arg[1];
  casadi_real *res[1];
  gains[0] = P; gains[1] = I; gains[2] = D; gains[3] = setpoint_filter_s;
  arg[0] = gains;
  res[0] = pidf->coefficients;
  estune_pidf_coefficients_of(arg, res);
}}

/* The state of a loop that has settled at a tension with a constant effort. */
ESTUNE_PIDF_EXPORT void estune_pidf_at_rest(estune_pidf *pidf, casadi_real tension,
                                            casadi_real effort) {{
  const casadi_real *arg[2];
  casadi_real *res[1];
  arg[0] = &tension; arg[1] = &effort;
  res[0] = pidf->state;
  estune_pidf_rest_state(arg, res);
}}

/* The gains this file was made with, at rest without tension. */
ESTUNE_PIDF_EXPORT void estune_pidf_init(estune_pidf *pidf) {{
  estune_pidf_gains(pidf, {gains});
  estune_pidf_at_rest(pidf, 0, 0);
}}

/* The setpoint after its filter, N, at the last step. */
ESTUNE_PIDF_EXPORT casadi_real estune_pidf_setpoint(const estune_pidf *pidf) {{
  return pidf->state[{filtered}];
}}

/* Makes the next step at these signals give exactly this effort, whatever the gains were. */
ESTUNE_PIDF_EXPORT void estune_pidf_take_over(estune_pidf *pidf, casadi_real setpoint,
                                              casadi_real measurement, casadi_real effort) {{
  casadi_real state[{states}];
  const casadi_real *arg[5];
  casadi_real *res[1];
  int i;
  for (i = 0; i < {states}; i++) state[i] = pidf->state[i];
  arg[0] = pidf->coefficients; arg[1] = state;
  arg[2] = &setpoint; arg[3] = &measurement; arg[4] = &effort;
  res[0] = pidf->state;
  estune_pidf_bumpless(arg, res);
}}

/* One sample. Returns the effort within its limits; excess is what they cut off, or no address. */
ESTUNE_PIDF_EXPORT casadi_real estune_pidf_step(estune_pidf *pidf, casadi_real setpoint,
                                                casadi_real measurement, casadi_real *excess) {{
  casadi_real state[{states}], effort;
  const casadi_real *arg[4];
  casadi_real *res[3];
  int i;
  for (i = 0; i < {states}; i++) state[i] = pidf->state[i];
  arg[0] = pidf->coefficients; arg[1] = state;
  arg[2] = &setpoint; arg[3] = &measurement;
  res[0] = pidf->state; res[1] = &effort; res[2] = excess;
  estune_pidf_sample(arg, res);
  return effort;
}}

/* One sample beside a feed-forward; returns their sum, and the limits are those of the sum. Limit
 * is the greatest size of it that the drive gives at present, or zero. */
ESTUNE_PIDF_EXPORT casadi_real estune_pidf_step_beside(estune_pidf *pidf, casadi_real forward,
                                                       casadi_real limit, casadi_real setpoint,
                                                       casadi_real measurement,
                                                       casadi_real *excess) {{
  casadi_real *limits = pidf->coefficients + {limits}, rig_low = limits[0], rig_high = limits[1];
  casadi_real low = limit > 0 ? casadi_fmax(rig_low, -limit) : rig_low;
  casadi_real high = limit > 0 ? casadi_fmin(rig_high, limit) : rig_high, effort;
  limits[0] = low - forward;
  limits[1] = high - forward;
  effort = estune_pidf_step(pidf, setpoint, measurement, excess) + forward;
  limits[0] = rig_low;
  limits[1] = rig_high;
  return casadi_fmin(casadi_fmax(effort, low), high);
}}

/* Sets the gains so that the next step at these signals gives what it would have given. */
ESTUNE_PIDF_EXPORT void estune_pidf_exchange(estune_pidf *pidf, casadi_real P, casadi_real I,
                                             casadi_real D, casadi_real setpoint_filter_s,
                                             casadi_real setpoint, casadi_real measurement) {{
  estune_pidf ahead = *pidf;
  casadi_real excess, effort = estune_pidf_step(&ahead, setpoint, measurement, &excess);
  estune_pidf_gains(pidf, P, I, D, setpoint_filter_s);
  estune_pidf_take_over(pidf, setpoint, measurement, effort + excess);
}}
"""


def controller_source(settings: ControllerSettings, gains: Gains) -> str:
    """C file of a controller with these settings compiled in."""
    return _TEXT.format(
        software=version("estune"),
        period_us=1e6 / settings.sampling_Hz,
        sampling_Hz=settings.sampling_Hz,
        derivative_filter_s=settings.derivative_filter_s,
        output_min_N=settings.output_min_N,
        output_max_N=settings.output_max_N,
        generated=_generated(settings),
        coefficients=COEFFICIENTS,
        coefficient_names=", ".join(pidf.Coefficients._fields),
        states=STATES,
        state_names=", ".join(pidf.PidfState._fields),
        filtered=pidf.PidfState._fields.index("filtered_setpoint"),
        limits=pidf.Coefficients._fields.index("output_min_N"),
        gains=", ".join(repr(value) for value in gains.as_tuple()),
    )


def _generated(settings: ControllerSettings) -> str:
    """Functions of `estune.core.pidf` as C, under names of their own."""
    import casadi as ca  # noqa: PLC0415  slow to import, and only needed to make the text

    # Lets numpy's functions, in which the controller is written, act on CasADi expressions.
    ca.GlobalOptions.setNumpyMode(1)
    gains = ca.SX.sym("gains", len(GAIN_NAMES))
    column = ca.SX.sym("coefficients", COEFFICIENTS)
    memory = ca.SX.sym("memory", STATES)
    r, y, u = (ca.SX.sym(name) for name in ("setpoint", "measurement", "effort"))
    c = pidf.Coefficients(*ca.vertsplit(column))
    state = pidf.PidfState(*ca.vertsplit(memory))
    following, effort, excess = pidf.step(c, state, r, y)
    taken_over = pidf.bumpless(c, state, r, y, u)
    coefficients = pidf.symbolic_coefficients(settings, *ca.vertsplit(gains))
    functions: dict[str, tuple[list[Any], list[Any]]] = {
        "coefficients_of": ([gains], [ca.vertcat(*coefficients)]),
        "rest_state": ([y, u], [ca.vertcat(*pidf.state_at_rest(y, u))]),
        "bumpless": ([column, memory, r, y, u], [ca.vertcat(*taken_over)]),
        "sample": ([column, memory, r, y], [ca.vertcat(*following), effort, excess]),
    }
    generator = ca.CodeGenerator("estune_pidf.c", {"with_header": False})
    for name, (inputs, outputs) in functions.items():
        dense = [ca.densify(output) for output in outputs]  # C writes structural nonzeros only
        generator.add(ca.Function(f"estune_pidf_{name}", inputs, dense))
    bodies = _BODY.findall(generator.dump())
    return "\n\n".join(
        f"static void estune_pidf_{name}(const casadi_real **arg, casadi_real **res) {{{body}}}"
        for name, body in zip(functions, bodies, strict=True)
    )
