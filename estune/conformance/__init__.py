"""Conformance suites: classes of tests that the tests of a package of your own inherit.

::

    from estune.conformance.rig import RigConformance


    class TestMyRig(RigConformance):
        @pytest.fixture(scope="class")
        @classmethod
        def endpoint(cls):
            with my_rig_started() as address:
                yield address

`RigConformance` tests a rig by the messages it exchanges, in whatever language it is written; the
classes of the modules `tuner`, `driver` and `recordings` test a tuner, a driver and a reader of
records. They need pytest. A rig that runs already is tested by
`python -m estune.conformance --endpoint tcp/127.0.0.1:7447`.
"""

import pytest

_SUITES = ("wire_client", "rig_trials", "rig_commands", "rig", "tuner", "recordings", "driver")
pytest.register_assert_rewrite(*(f"{__name__}.{suite}" for suite in _SUITES))
