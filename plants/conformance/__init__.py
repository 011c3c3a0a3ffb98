"""Conformance suites of what a package of your own adds to a plant: classes of tests to inherit.

::

    from plants.conformance.effect import EffectConformance


    class TestMyEffect(EffectConformance):
        @pytest.fixture
        def effect(self):
            return MyEffect

They need pytest.
"""

import pytest

pytest.register_assert_rewrite(f"{__name__}.effect")
