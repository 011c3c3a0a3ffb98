import numpy as np

from experiments.paper.demonstrations.workspace_boundary import (
    reference_boundary_trial,
    run_boundary,
)


def test_hand_over_at_the_boundary_keeps_the_cable_taut():
    trial = reference_boundary_trial()
    handed, parallel = run_boundary(trial)
    for traces in (handed, parallel):
        assert np.count_nonzero(np.diff(traces.in_tension)) >= 4  # both switch back and forth
    assert np.abs(handed.jump_N).max() < 1e-9
    assert np.abs(parallel.jump_N).max() > trial.platform.reel.tension_N
    assert handed.tension_N.min() > trial.rules.tension_min_N
    assert parallel.tension_N.min() == 0.0
    # The user pushes the platform some centimetres beyond the boundary, then releases it.
    assert handed.position_m.max() < 0.1 < parallel.position_m.max()
