"""A heavy cable that stretches by Hooke's law."""

import numpy as np
from numpy.typing import ArrayLike

from estune.core.quantities import Numbers, checked_array, scalar_or_array
from plants.models.path_structure import GRAVITY_M_S2


def elastic_rise_m(
    rest_density_kg_m: ArrayLike,
    stiffness_EA_N: ArrayLike,
    tension_1_N: ArrayLike,
    tension_3_N: ArrayLike,
) -> Numbers:
    """Height of the far end above the attachment of a cable that stretches, m.

    Implements (7).

    `dz = (|T_3| - |T_1| + (|T_3|^2 - |T_1|^2)/(2 EA)) / (mu_0 g)`: exact for a cable that obeys
    Hooke's law. With the rest length p, an element is stretched to `(1 + T/EA) dp`, which is (2)
    for an element; `dz/dp = V/T (1 + T/EA)` and `dT/dp = mu_0 g V/T`. It is the vertical relation
    of the elastic catenary of Irvine (Cable Structures, 1981).

    Raises:
        InvalidInput: a value is not finite or out of its range.
    """
    mu_0 = checked_array("rest density", rest_density_kg_m, "kg/m", above=0.0)
    EA = checked_array("stiffness EA", stiffness_EA_N, "N", above=0.0)
    T_1 = checked_array("tension_1", tension_1_N, "N", least=0.0)
    T_3 = checked_array("tension_3", tension_3_N, "N", least=0.0)
    rise = (T_3 - T_1) * (1.0 + 0.5 * (T_1 + T_3) / EA) / (mu_0 * GRAVITY_M_S2)
    return scalar_or_array(np.asarray(rise))
