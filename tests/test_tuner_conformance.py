"""The conformance suite on every tuner."""

import pytest

from estune.conformance.tuner import TunerConformance
from estune.core.gains import Gains
from estune.tuners import TUNERS, SearchSpace, create_tuner

SPACE = SearchSpace.around(Gains(0.5, 20.0, 0.01, 0.03))


class TestEveryTuner(TunerConformance):
    @pytest.fixture(params=TUNERS)
    def tuner(self, request):
        return create_tuner(request.param, SPACE)
