"""Whether a proven remedy still has its gain, by pairs of turns without it and with it.

A pair is judged by the measures that the proof showed to be better, as the proof is. One pair
repeats to a few per cent, so that one without a gain is only a suspicion, and is repeated at once.
"""

import math
from collections.abc import Mapping, Sequence
from enum import StrEnum
from typing import Any

import numpy as np

from estune.core.quantities import FloatArray
from estune.proof.trials import CONFIDENCE, GAIN, MEASURES

COUNTED = 3
"""Measures that count as a gain or a loss: cost, tracking, reversals. Rest stops a pair by itself,
and repeats to 10 % only."""
PAIRS_MIN = 2
"""One pair may have met a disturbance."""


class Gain(StrEnum):
    """What pairs show of a remedy."""

    KEPT = "kept"
    SUSPECT = "suspect"
    LOST = "lost"


def gained_measures(proof: Mapping[str, Any]) -> tuple[str, ...]:
    """The measures that a proof showed to be better."""
    ratios = proof["ratios"]
    return tuple(name for name in MEASURES[:COUNTED] if ratios[name]["high"] < 1.0 - GAIN)


def gain_of(
    pairs: Sequence[Sequence[float]],
    proof: Mapping[str, Any],
    false_alarm_pairs: float,
    scatter_min: float,
) -> Gain:
    """What the newest pairs show: those since the last one that showed the gain.

    A remedy keeps its gain where one of the proven measures is better by 2 % and none is worse by
    as much. It has lost it where Student's interval of the mean says the opposite of all of them,
    or that another is worse; or where so many pairs in a row show no gain that a remedy at the
    limit does so more seldom than once in `false_alarm_pairs`: a suspicion ends within log2 of it.
    The scatter of a pair is that of these pairs and of those of the proof together.

    Args:
        pairs: Ratios of with to without in the order of `MEASURES`, oldest first.
        proof: The proof, as a patch has it.
        false_alarm_pairs: Mean number of pairs between false alarms of a remedy whose gain is 2 %;
            of a larger one they are rarer.
        scatter_min: Lower bound of the relative standard deviation of one measure.
    """
    from scipy.special import stdtrit  # noqa: PLC0415  slow to import

    logs = np.log(np.array(pairs, dtype=np.float64))[:, :COUNTED]
    of = [MEASURES.index(name) for name in gained_measures(proof)]
    least, most = math.log1p(-GAIN), math.log1p(GAIN)
    if (logs[-1, of] < least).any() and not (logs[-1] > most).any():
        return Gain.KEPT
    count = len(logs)
    if 2.0**count >= false_alarm_pairs:
        return Gain.LOST
    if count < PAIRS_MIN:
        return Gain.SUSPECT
    known, variance = _proven_scatter(proof)
    freedom = known + count - 1
    variance = (known * variance + ((logs - logs.mean(axis=0)) ** 2).sum(axis=0)) / freedom
    deviation = np.sqrt(np.maximum(variance, 2.0 * scatter_min**2) / count)
    low = logs.mean(axis=0) - float(stdtrit(freedom, 1.0 - 1.0 / false_alarm_pairs)) * deviation
    return Gain.LOST if (low[of] > least).all() or (low > most).any() else Gain.SUSPECT


def _proven_scatter(proof: Mapping[str, Any]) -> tuple[int, FloatArray]:
    """Degrees of freedom of a proof, and the variances of the log ratio of one of its pairs."""
    from scipy.special import stdtrit  # noqa: PLC0415  slow to import

    pairs = proof["pairs"]
    freedom = 2 * pairs - 2
    wide = float(stdtrit(freedom, 0.5 + 0.5 * CONFIDENCE))
    ends = [(proof["ratios"][m]["low"], proof["ratios"][m]["high"]) for m in MEASURES[:COUNTED]]
    half = 0.5 * np.log([high / low for low, high in ends])
    return freedom, pairs * (half / wide) ** 2
