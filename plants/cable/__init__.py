"""The cable between a reel and what it pulls: slack, sag, stretch and its notes.

End 1 is the attachment at the reel, end 3 the far end; z points up, x away from the reel. Along
the cable from 1 to 3 the horizontal tension is constant and the vertical one grows by the weight
passed, so the far end's tension is (T_x, T_3z) and the pull on it the opposite vector.
"""

from plants.cable.elastic import (
    ElasticCatenary,
    elastic_between,
    elastic_catenary,
    elastic_rise_m,
)
from plants.cable.hanging import Catenary, catenary, far_tension_N
from plants.cable.taut import (
    GRAVITY_M_S2,
    least_taut_tension_N,
    loaded_density_kg_m,
    string_frequency_Hz,
    tension_ratio,
)
from plants.cable.triples import ADMISSIBLE, DEPENDENT, NAMES, Solution

__all__ = [
    "ADMISSIBLE",
    "DEPENDENT",
    "GRAVITY_M_S2",
    "NAMES",
    "Catenary",
    "ElasticCatenary",
    "Solution",
    "catenary",
    "elastic_between",
    "elastic_catenary",
    "elastic_rise_m",
    "far_tension_N",
    "least_taut_tension_N",
    "loaded_density_kg_m",
    "string_frequency_Hz",
    "tension_ratio",
]
