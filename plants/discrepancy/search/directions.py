"""From where the directions of effects are looked for, and over what."""

from collections.abc import Sequence
from dataclasses import replace

from plants.discrepancy.search.background import Background, Suggest, orthonormal
from plants.discrepancy.search.bench import Attempt, Bench, Numbers
from plants.discrepancy.search.cable_block import block_of
from plants.discrepancy.search.score import open_block
from plants.discrepancy.search.screen import Screened, screen
from plants.effects import Effect, Port

SCREENED = 12_000
"""Entries that directions are compared over."""


def all_screened(
    bench: Bench, effects: Sequence[type[Effect]], seen: Sequence[Background]
) -> dict[str, Screened]:
    """Each effect's direction, by slug."""
    return {e.name: screen(e, bench.predictor((e,)), seen) for e in effects}


def screened_further(
    bench: Bench,
    effects: Sequence[type[Effect]],
    seen: Sequence[Background],
    current: Attempt,
    suggest: Suggest,
) -> dict[str, Screened]:
    """Each further effect's direction, by slug; those of a block without one in that alone."""
    cable = open_block(current) == "cable"
    block = [background(bench, current, suggest, cable=True)] if cable else seen
    # What an actuator does not pass on moves nothing behind it.
    driven = tuple(e for e in current.effects if e.port is Port.ACTUATOR)
    looked = {}
    for e in effects:
        there = cable and block_of(e) == "cable"
        beside = driven if there else ()
        if rings(e):
            beside = current.effects  # it rings with what drives it, and friction damps it
        looked[e.name] = screen(e, bench.predictor((*beside, e)), block if there else seen)
    return looked


def rings(effect: type[Effect]) -> bool:
    """Whether an effect has a frequency of its own."""
    return any(p.unit == "Hz" for p in effect.parameters().values())


def background(
    bench: Bench,
    attempt: Attempt,
    suggest: Suggest,
    moves: Numbers | None = None,
    *,
    cable: bool = False,
) -> Background:
    """What directions are compared with, at a fit.

    Args:
        bench: Model and records.
        attempt: The fit.
        suggest: What the data suggest for parameters.
        moves: Numbers of the values that calibrations may move; None is what the fit moved.
        cable: Whether the cable and gauge block alone is looked at.
    """
    fitted = attempt.fitted
    # A product over many entries is as well known from some of them.
    sample = fitted.predictor.index.sample[fitted.entries]
    some = sample % max(1, sample.size // SCREENED) == 0
    entries, residual = fitted.entries[some], fitted.residuals[some]
    moves = fitted.moved if moves is None else moves
    slope = fitted.predictor.linearise(fitted.values, moves, entries)[1].T
    block = bench.cable_block(replace(fitted, entries=entries)) if cable else None
    if block is not None:
        residual, slope = block.left(residual), block.left(slope)
    basis = orthonormal(slope)
    return Background(
        values=attempt.values,
        residual=residual - (basis @ residual) @ basis,
        basis=basis,
        entries=entries,
        lowest_Hz=1.0 / max(m.duration_s for m in bench.measurements),
        highest_Hz=0.45 * min(m.sampling_Hz for m in bench.measurements),
        suggest=suggest,
        block=block,
    )
