"""Loops of known equations."""

import numpy as np

from estune.loop_model.model import LoopModel, exchanged
from estune.loop_model.poles import pair_coordinates


def loop_of_taps(poles, zeros, dead_samples):
    """A model of two stable poles by a1 and a2 of A and the coefficients of B, in q^-1."""
    coordinates = tuple(pair_coordinates(*poles).tolist())
    return LoopModel(coordinates, tuple(exchanged(np.array(zeros)).tolist()), dead_samples)
