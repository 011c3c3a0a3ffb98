"""Statics of the cable between a reel and its load: slack, sag, stretch and string frequency.

End 1 is the attachment at the reel, end 3 the far end; z points up, x away from the reel. From 1
to 3 the horizontal tension is constant and the vertical tension grows by the weight in between.
"""

from experiments.paper.cable.elastic import elastic_rise_m
from experiments.paper.cable.hanging import Catenary, catenary, far_tension_N
from experiments.paper.cable.taut import (
    least_taut_tension_N,
    loaded_density_kg_m,
    string_frequency_Hz,
)
from experiments.paper.cable.triples import ADMISSIBLE, DEPENDENT, NAMES, Solution

__all__ = [
    "ADMISSIBLE",
    "DEPENDENT",
    "NAMES",
    "Catenary",
    "Solution",
    "catenary",
    "elastic_rise_m",
    "far_tension_N",
    "least_taut_tension_N",
    "loaded_density_kg_m",
    "string_frequency_Hz",
]
