"""Attempts to explain what is left with one more effect: where fits begin, and how far they go."""

import itertools
from collections.abc import Sequence

import numpy as np

from estune.core.quantities import FloatArray
from plants.diagnosis.prediction.prediction import Predictor
from plants.diagnosis.search import thresholds
from plants.diagnosis.search.model_comparison import is_sufficient
from plants.diagnosis.search.model_fitter import CandidateFit, ModelFitter
from plants.diagnosis.search.score_test import ScreeningResult, is_limit
from plants.diagnosis.search.screening import has_resonance
from plants.effects import Effect, Port

SWITCHED = 0.3
"""Size a member of a family is switched on with to see its direction, by that it inherits."""
TRADED = (0.25, 0.5)
"""Shares of the size inherited that go over to one of its own."""
ROUGH = np.array([0.1, 0.3, 1.0, 2.0, 3.5, 6.0, 12.0])
"""Sizes tried of an effect that no direction shows, relative to the usual one."""
STARTS = 2
"""Starts of an effect that fits are begun from."""
FIRST_ROUNDS = 3
"""Rounds of a fit before the attempts far behind are left where they are."""
LONGEST = 60
"""The same of the best attempt's fit: a cable that sags shifts the zero of each record with its
weight, and both find their way together in small steps."""
FINISHED = 4
"""Attempts whose fits are finished."""
BEHIND = 3.0
"""Ratio of powers left to the best attempt's, from which on a fit is not finished where the best
will do."""


def reduced(bench: ModelFitter, attempts: Sequence[CandidateFit]) -> list[CandidateFit]:
    """The attempts, and a simpler one of its family beside each that is more than it needs to be.

    A fit with more values to move may find its way where the simpler one did not.
    """
    found = list(attempts)
    for a in attempts:
        effect = a.effects[-1]
        source, given = inheritance(effect)
        simpler = next((o for o in attempts if o.effects[-1].name == source), None)
        if simpler is None or thresholds.large_enough(effect, a.values, bench.scale):
            continue
        back = {f"{source}.{of}": a.values[f"{effect.name}.{to}"] for of, to in given.items()}
        row = simpler.fitted.predictor.row(a.values | back)
        found.append(bench.attempt(simpler.effects, row[None, :], FIRST_ROUNDS))
    return found


def finished(
    bench: ModelFitter, base: CandidateFit, attempts: Sequence[CandidateFit]
) -> list[CandidateFit]:
    """The best attempt with each effect, those that lead fitted to the end, the best first."""
    each: dict[str, CandidateFit] = {}
    for a in sorted(attempts, key=lambda a: a.fit_J):
        each.setdefault(a.effects[-1].name, a)
    leading = list(each.values())
    if leading:
        leading[0] = bench.refine(leading[0], LONGEST)
    # What is far behind after a few rounds is not worth more, least of all where one will do.
    for n, a in enumerate(leading[1:FINISHED], 1):
        if not is_sufficient(base, leading[0]) or a.fit_J < BEHIND * leading[0].fit_J:
            leading[n] = bench.refine(a)
    return sorted(leading, key=lambda a: a.rank_J)


def may_be_nonlinear(one: ScreeningResult) -> bool:
    """Whether an effect may act so unlike a small one that no direction shows it."""
    bends = bool({Port.CABLE, Port.EYELET} & set(one.effect.ports()))
    sticks = one.effect.resists and one.effect.states > 0
    return (bends or sticks or is_limit(one.effect)) and one.usual_change >= thresholds.SHOWN


def coarse_fit(bench: ModelFitter, effect: type[Effect]) -> CandidateFit:
    """The model as given with an effect of several sizes, each record's zero put right."""
    predictor = bench.predictor((effect,))
    rows = np.repeat(predictor.start[None, :], ROUGH.size, axis=0)
    for n, f in enumerate(predictor.free):
        if f.owner != effect.name or f.neutral is None:
            continue
        sizes = f.neutral + ROUGH * (f.start - f.neutral)
        if is_limit(effect):
            sizes = f.start * np.linspace(1.2, 0.5, ROUGH.size)
        rows[:, n] = np.clip(sizes, f.low, f.high)
    for most in (4, 3, 2):  # some only find their zeros from near
        rows = bench.best_starts(predictor, bench.placed(predictor, rows), most)
    return bench.attempt((effect,), rows, FIRST_ROUNDS)


def fit_added_effect(
    bench: ModelFitter, current: CandidateFit, one: ScreeningResult, others: Sequence[CandidateFit]
) -> CandidateFit:
    """The current model with one more effect, fitted from the starts that its screening found.

    Args:
        bench: Model and records.
        current: The current model.
        one: The effect's screening.
        others: Attempts with other effects; a simpler one of its family is begun with, too.
    """
    effects = (*current.effects, one.effect)
    predictor = bench.predictor(effects)
    rows = []
    for row in one.starts:
        values = one.predictor.values(row)
        if current.effects:  # its screening was at the base model
            values = {n: v for n, v in values.items() if n.startswith(f"{one.effect.name}.")}
        rows.append(predictor.row(current.values | values))
    # A wave that is a little too long or too short may do worse than none before it is fitted.
    waves = any(p.is_phase for p in one.effect.parameters().values())
    most = len(rows) if waves else STARTS
    begun = bench.best_starts(predictor, bench.placed(predictor, np.array(rows)), most)
    source, _ = inheritance(one.effect)
    simpler = next((a for a in others if a.effects[-1].name == source), None)
    if simpler is not None:
        # What is near a simpler law's fit leaves less to begin with, and may lead nowhere else.
        begun = np.concatenate([begun, _inherited(bench, predictor, one, simpler)])
    if has_resonance(one.effect):
        # One round does not tell which of two frequencies is near enough to lead to the mode's.
        found = [bench.attempt(effects, row[None, :], FIRST_ROUNDS) for row in begun]
        return min(found, key=lambda a: a.fit_J)
    return bench.attempt(effects, begun, FIRST_ROUNDS)


def _inherited(
    bench: ModelFitter, predictor: Predictor, one: ScreeningResult, simpler: CandidateFit
) -> FloatArray:
    """Starts from the fit of a simpler member of the family, shape (some, free).

    The best with what is its own switched on, and the best with a part of what it inherits given
    over to that: friction as large at rest that falls with speed is far from any that does not.
    """
    name, declared = one.effect.name, one.effect.parameters()
    source, given = inheritance(one.effect)
    own = {f"{name}.{to}": simpler.values[f"{source}.{of}"] for of, to in given.items()}
    sizes = [n for n, p in declared.items() if p.neutral is not None and n not in given.values()]
    own |= {f"{name}.{n}": declared[n].neutral or 0.0 for n in sizes}
    grids = {n: values for n, values in one.grids.items() if n not in given.values()}
    shapes = [dict(zip(grids, v, strict=True)) for v in itertools.product(*grids.values())]
    rows = np.array(
        [
            predictor.row(simpler.values | own | {f"{name}.{n}": v for n, v in shape.items()})
            for shape in shapes
        ]
    )
    of, to = next(iter(given.items()))
    if declared[to].neutral is None:
        # No size is inherited: it is as large as usual.
        usual = {f"{name}.{n}": float(getattr(one.effect(), n)) for n in sizes}
        rows = np.array([predictor.row(predictor.values(row) | usual) for row in rows])
        return bench.best_starts(predictor, bench.placed(predictor, rows), STARTS)
    inherited = abs(simpler.values[f"{source}.{of}"])
    place = {f.name: n for n, f in enumerate(predictor.free)}
    ways = [rows]
    for size in sizes:
        traded = np.repeat(rows, len(TRADED), axis=0)
        shares = inherited * np.tile(TRADED, len(rows))
        traded[:, place[f"{name}.{size}"]] += shares
        traded[:, place[f"{name}.{to}"]] -= shares
        ways.append(traded)
        # As large as the size inherited is: a law that is bent shows its direction.
        step = SWITCHED * inherited
        ways[0] = bench.switched_on(predictor, ways[0], place[f"{name}.{size}"], step)
    return np.concatenate(
        [bench.best_starts(predictor, bench.placed(predictor, way), 1) for way in ways]
    )


def inheritance(effect: type[Effect]) -> tuple[str, dict[str, str]]:
    """Slug of the effect whose fit another begins with; its parameters, and which those are."""
    given = {of: to for to, of in effect.inherits.items()}
    return ("" if effect.extends is None else effect.extends.name), given
