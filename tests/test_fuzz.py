"""Fuzz test: no message breaks a rig, and no damaged message is accepted."""

from experiments.fuzz import fuzz


def test_fuzz_finds_no_faults():
    run = fuzz(10_000, seed=1)
    assert run.faults == []
    assert len(run.rig.requests) > 3000
    assert run.counts["submit, refused"] > 3000
    assert all(f"{name}, refused" in run.counts for name in ("frame", "part", "live", "gains"))
