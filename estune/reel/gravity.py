"""Feed-forward of the cable's weight, added to the tension setpoint of the reel.

The force F_g adds to the setpoint: below zero where the cable rises from the reel and hangs on its
far end, above zero where the reel carries the weight. z points up, end 1 is the attachment at the
reel, end 3 the far end.
"""

import numpy as np
from numpy.typing import ArrayLike

from estune.core.quantities import SMALLEST, Numbers, checked_array, scalar_or_array


def gravity_force_N(
    weight_N_m: ArrayLike, length_m: ArrayLike, *, tension_1z_N: ArrayLike, tension_1_N: ArrayLike
) -> Numbers:
    """The compensation from the tension vector at the reel, `-F_g = mu g ds T_1z/|T_1|`.

    Implements (8).

    The share of the cable's weight along its direction at the reel, so `|F_g| <= mu g ds`. A cable
    without tension, or with a negative one by gauge noise, hangs down from the reel:
    `F_g = mu g ds`.

    Args:
        weight_N_m: Weight per length mu g, N/m, zero or above; any shape.
        length_m: Deployed length ds, m, zero or above.
        tension_1z_N: Vertical tension at the reel T_1z, N.
        tension_1_N: Tension at the reel |T_1|, N; any sign.

    Raises:
        InvalidInput: a value is not finite, or a weight or length below zero.
    """
    weight = checked_array("weight_N_m", weight_N_m, "N/m", least=0.0) * checked_array(
        "length_m", length_m, "m", least=0.0
    )
    V_1 = checked_array("tension_1z_N", tension_1z_N, "N")
    T_1 = checked_array("tension_1_N", tension_1_N, "N")
    cosine = np.clip(V_1, -np.abs(T_1), np.abs(T_1)) / np.where(T_1 > 0.0, T_1, 1.0)
    return scalar_or_array(np.asarray(np.where(T_1 > 0.0, -cosine, 1.0) * weight))


def gravity_force_by_position_N(
    weight_N_m: ArrayLike, length_m: ArrayLike, *, rise_m: ArrayLike, tension_1_N: ArrayLike
) -> Numbers:
    """The compensation from the far end's height, with the limit at low tension.

    Implements (9).

    `-F_g = mu g dz (1 + mu g dz/(2 |T_1|)) - (mu g ds)^2/(2 |T_1|)`, that is (8) with T_1z from
    (4) (the paper states (5), which is impossible). At low tension the last term grows without
    bound: the tension is then below that of the cable's weight alone, and no T_1z within `|T_1|`
    corresponds to it. So F_g is limited to `mu g ds`, the bound of (8).

    The weight adds `|T_3| - |T_1| = mu g dz` between the ends; (9) is less by
    `(mu g)^2 (ds^2 - dz^2)/(2 |T_1|)`, of second order in weight over tension.

    Args:
        weight_N_m: Weight per length mu g, N/m, zero or above; any shape.
        length_m: Deployed length ds, m, zero or above.
        rise_m: Height of the far end above the reel dz, m.
        tension_1_N: Tension at the reel |T_1|, N; zero or below means a slack cable.

    Raises:
        InvalidInput: a value is not finite, or a weight or length below zero.
    """
    w = checked_array("weight_N_m", weight_N_m, "N/m", least=0.0)
    s = checked_array("length_m", length_m, "m", least=0.0)
    z = checked_array("rise_m", rise_m, "m")
    T_1 = checked_array("tension_1_N", tension_1_N, "N")
    # Multiplied by |T_1|/(mu g ds), to avoid dividing by a tension of zero.
    # A length whose reciprocal is no number would make the share infinite.
    share = np.divide(z, s, out=np.zeros(np.broadcast(z, s).shape), where=s >= SMALLEST)
    V_1 = share * (T_1 + 0.5 * w * z) - 0.5 * w * s
    return gravity_force_N(w, s, tension_1z_N=V_1, tension_1_N=T_1)
