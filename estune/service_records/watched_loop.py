"""A loop that is watched record by record: its margins, and whether the plant has changed.

A record that looks like another plant (`plant_change`) is set apart with those after it, which are
not taken into the fit, until together they look like the plant known so far or are of another one.
A change is told by records that are unlikely together and whichever one of them is left out: any
one may be disturbed.
"""

from collections.abc import Sequence
from typing import NamedTuple

from estune.core.gains import Gains
from estune.core.pidf import ControllerSettings
from estune.loop_model.fitting import fit_loop
from estune.loop_model.intervals import PredictedMargins
from estune.loop_model.loop_fit import LoopFit
from estune.loop_model.plant_error import plant_error
from estune.loop_model.prediction import StepTrial
from estune.loop_model.records import LoopRecord
from estune.service_records.identification import ServiceLoop
from estune.service_records.judgement import Judgement, judge, margins_of
from estune.service_records.plant_change import PlantEvidence, chance, evidence

KEPT = 6
"""Newest records that the loop is identified from."""

REMEMBERED = 60
"""Newest records that another one is compared with. Of six the gain of an 8 Hz loop is known to
5 % alone, which halves what six more show of a change."""

SUSPECT = 0.2
"""Probability up to which records are set apart: a quiet one costs another record, a changed one
that is not set apart the time to the next. `experiments.margin_watch` counts both."""

FALSE_ALARM = 1e-6
"""Probability, without a change, of what records that are set apart show together, from which they
are of another plant: ten rigs with a record a minute make 14 400 tests a day."""

DISTURBED = 1e-3
"""The same of those that are left when any one of them is taken out as disturbed."""

UNDECIDED = 8
"""Records that are set apart at most; a plant that changes less than they show is followed."""

Suspects = tuple[tuple[LoopRecord, PlantEvidence], ...]
"""Records, and what they show of another plant."""


class WatchedLoop(NamedTuple):
    """What is known of a loop.

    Attributes:
        records: The newest records of the present plant, at most `KEPT`.
        fit: The loop identified from them; None before the first.
        reference: The fit that evidence is of: that of the first records.
        known: What records of the present plant show of another one, at most `REMEMBERED`.
        suspects: Records that look like another plant, and what they show of it.
    """

    records: tuple[LoopRecord, ...] = ()
    fit: LoopFit | None = None
    reference: LoopFit | None = None
    known: tuple[PlantEvidence, ...] = ()
    suspects: Suspects = ()


class WatchedMargins(NamedTuple):
    """What the records of a watched loop show.

    Attributes:
        judgement: Whether they are known.
    """

    loop: ServiceLoop
    margins: PredictedMargins
    judgement: Judgement


def observe(
    known: WatchedLoop,
    record: LoopRecord,
    sampling_Hz: float,
    settling_time_s: float,
    *,
    refit: bool = True,
) -> tuple[WatchedLoop, bool]:
    """A loop with one record more, and whether its plant has changed.

    Args:
        refit: Whether the fit follows the records; whether a plant has changed, which is told by
            the reference, does not depend on it.
    """
    newest: tuple[LoopRecord, ...] = (record,)
    shown: tuple[PlantEvidence, ...] = ()
    reference = known.reference
    if reference is not None:
        suspects = (*known.suspects, (record, evidence(reference, record)))
        starts = len(suspects)
        known, suspects = _parted(known, suspects)
        if is_another(known, [one for _, one in suspects], starts):
            changed = tuple(one for one, _ in suspects)
            return _begun(changed, fit_loop(changed, sampling_Hz, settling_time_s)), True
        suspects = _less_disturbed(known, suspects)
        newest, shown = tuple(r for r, _ in suspects), tuple(one for _, one in suspects)
        likely = starts * chance(reference, known.known, shown)
        if likely < SUSPECT and len(suspects) < UNDECIDED:
            return known._replace(suspects=suspects), False
    records = (*known.records, *newest)
    begins = len(records) <= KEPT
    fit = known.fit
    if refit or begins:
        fit = fit_loop(records[-KEPT:], sampling_Hz, settling_time_s, fit)
    if fit is not None and begins:
        return _begun(records, fit), False
    remembered = (*known.known, *shown)[-REMEMBERED:]
    return WatchedLoop(records[-KEPT:], fit, known.reference, remembered), False


def _begun(records: tuple[LoopRecord, ...], fit: LoopFit) -> WatchedLoop:
    """A loop of few records: what they show is known anew with each fit."""
    return WatchedLoop(records, fit, fit, tuple(evidence(fit, one) for one in records))


def _parted(known: WatchedLoop, suspects: Suspects) -> tuple[WatchedLoop, Suspects]:
    """A loop that takes those suspects from before a change, and the suspects after it.

    A change may have begun with any of them, most likely where those from there on are least
    likely without one. A quiet record that is set apart by chance would hide a change after it.
    """
    assert known.reference is not None  # noqa: S101  it has records
    shown = [one for _, one in suspects]
    likely = [chance(known.reference, known.known, shown[i:]) for i in range(len(shown))]
    begun = likely.index(min(likely))
    records = (*known.records, *(record for record, _ in suspects[:begun]))[-KEPT:]
    remembered = (*known.known, *shown[:begun])[-REMEMBERED:]
    return known._replace(records=records, known=remembered), suspects[begun:]


def is_another(known: WatchedLoop, shown: Sequence[PlantEvidence], starts: int) -> bool:
    """Whether records are of another plant than a known one, whichever one is left out.

    Args:
        shown: What the records show.
        starts: Beginnings of a change that they were chosen from; each could be chance.
    """
    assert known.reference is not None  # noqa: S101  it has records
    fit, before = known.reference, known.known
    if len(shown) < 2 or starts * chance(fit, before, shown) > FALSE_ALARM:
        return False
    without = ([*shown[:i], *shown[i + 1 :]] for i in range(len(shown)))
    return all(chance(fit, before, others) < DISTURBED for others in without)


def _less_disturbed(known: WatchedLoop, suspects: Suspects) -> Suspects:
    """Records without one that is of another plant by itself, where the others are not."""
    assert known.reference is not None  # noqa: S101  it has records
    for i, (_, one) in enumerate(suspects):
        others = (*suspects[:i], *suspects[i + 1 :])
        if len(others) > 1 and chance(known.reference, known.known, [one]) < FALSE_ALARM:
            shown = [other for _, other in others]
            if chance(known.reference, known.known, shown) >= SUSPECT:
                return others
    return suspects


def judged_margins(
    known: WatchedLoop, trial: StepTrial, gains: Gains, settings: ControllerSettings
) -> WatchedMargins:
    """The margins of a watched loop with some gains.

    Args:
        known: A loop with at least one record.
        trial: The step that cost and overshoot are predicted for.
        settings: The fixed part of the controller.
    """
    assert known.fit is not None  # noqa: S101  it has a record
    error = plant_error(known.fit, known.records)
    loop = ServiceLoop(known.fit, known.records, settings, error)
    margins, margin = margins_of(loop, trial, gains)
    return WatchedMargins(loop, margins, judge(loop, gains, margins, margin))
