"""Whatever comes over the link breaks nothing, and nothing damaged passes for a good message."""

from experiments.fuzz import fuzz


def test_nothing_that_is_sent_breaks_a_rig_or_passes_for_what_it_is_not():
    run = fuzz(10_000, seed=1)
    assert run.faults == []
    assert len(run.rig.asked) > 3000
    assert run.told["submit, refused"] > 3000
    assert all(f"{what}, refused" in run.told for what in ("frame", "part", "live", "gains"))
