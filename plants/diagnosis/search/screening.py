"""From where the directions of effects are looked for, and over what."""

from collections.abc import Sequence
from dataclasses import replace

from plants.diagnosis.search.cable_block import block_of
from plants.diagnosis.search.model_comparison import family_of, open_block
from plants.diagnosis.search.model_fitter import CandidateFit, ModelFitter, Numbers
from plants.diagnosis.search.score_context import InitialGuesses, ScoreContext, orthonormal
from plants.diagnosis.search.score_test import ScreeningResult, screen
from plants.effects import Effect

SCREENED = 12_000
"""Entries that directions are compared over."""
TWICE = 10
"""Further effects whose direction is looked at once more beside those there are."""


def screen_effects(
    bench: ModelFitter, effects: Sequence[type[Effect]], seen: Sequence[ScoreContext]
) -> dict[str, ScreeningResult]:
    """Each effect's direction, by slug."""
    return {e.name: screen(e, bench.predictor((e,)), seen) for e in effects}


def screened_further(
    bench: ModelFitter,
    effects: Sequence[type[Effect]],
    seen: Sequence[ScoreContext],
    current: CandidateFit,
    suggest: InitialGuesses,
) -> dict[str, ScreeningResult]:
    """Each further effect's direction, by slug; those of a block without one in that alone.

    All are looked at alone first, which is soon worked out; then the most promising beside the
    effects so far. What those do not let through, or bend, has another direction without them.
    """
    there = {member for e in current.effects for member in family_of(e.name)}
    cable = open_block(current) == "cable"
    block = [background(bench, current, suggest, cable=True)] if cable else seen

    def looked(e: type[Effect], beside: tuple[type[Effect], ...]) -> ScreeningResult:
        places = block if cable and block_of(e) == "cable" else seen
        return screen(e, bench.predictor((*beside, e)), places)

    # It rings with what drives it, and friction damps it.
    found = {e.name: looked(e, current.effects if has_resonance(e) else ()) for e in effects}
    further = [e for e in effects if e.name not in there]
    further.sort(key=lambda e: -found[e.name].screening_R2)
    for e in further[:TWICE]:
        if not has_resonance(e):
            found[e.name] = looked(e, current.effects)
    return found


def has_resonance(effect: type[Effect]) -> bool:
    """Whether an effect has a frequency of its own."""
    return any(p.unit == "Hz" for p in effect.parameters().values())


def background(
    bench: ModelFitter,
    attempt: CandidateFit,
    suggest: InitialGuesses,
    moves: Numbers | None = None,
    *,
    cable: bool = False,
) -> ScoreContext:
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
    slope = fitted.predictor.linearise(fitted.values, moves, entries, residual)[1].T
    block = bench.cable_block(replace(fitted, entries=entries)) if cable else None
    if block is not None:
        residual, slope = block.left(residual), block.left(slope)
    basis = orthonormal(slope)
    return ScoreContext(
        values=attempt.values,
        residual=residual - (basis @ residual) @ basis,
        basis=basis,
        entries=entries,
        lowest_Hz=1.0 / max(m.duration_s for m in bench.measurements),
        highest_Hz=0.45 * min(m.sampling_Hz for m in bench.measurements),
        suggest=suggest,
        block=block,
    )
