"""Result of a diagnosis as plain values: verdict, effects found, evidence."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Literal, NamedTuple

from estune.core.gains import Gains
from estune.core.quantities import FloatArray
from estune.recordings.issue import DataIssue
from plants.diagnosis.data.noise_floor import NoiseFloor
from plants.diagnosis.interval import Interval
from plants.diagnosis.next_data import NextExperiment, NextRecording
from plants.diagnosis.residual.localisation import ResidualLocation
from plants.effects import Effect
from plants.effects.plant_scale import written_unit
from plants.remedies import Offer, offers_for

Verdict = Literal["named", "incomplete", "ambiguous", "unknown", "none"]
"""`named`: the effects explain the prediction error; `incomplete`: most of it; `ambiguous`: the
records do not distinguish several effects; `unknown`: no declared effect explains it; `none`:
there is nothing to explain."""

LIMITED, FAULTY = 9, 10
"""Exit codes: the verdict stands with a reservation for what the records do not show; the data
have faults to be corrected first."""

Slugs = frozenset[str]


def family_of(effect: type[Effect]) -> str:
    """Name of an effect's family, or its own."""
    return effect.family or effect.name


def explained_share(before: float, after: float) -> float:
    """Share of the error power above the noise floor that is explained.

    Args:
        before: Mean square error without what explains it, in noise floors.
        after: That with it.
    """
    above = max(before, 1.0) - 1.0
    return (max(before, 1.0) - max(after, 1.0)) / above if above > 0.0 else 0.0


@dataclass(frozen=True, slots=True)
class NamedEffect:
    """An effect that was found.

    Attributes:
        parameters: Fitted values by name; in units of `input` and `output` for a plant that is no
            reel.
        sentence: What it is and how large, in plain words.
        effect: The effect with the fitted values, to be added to a model.
    """

    name: str
    title: str
    parameters: Mapping[str, Interval]
    sentence: str
    effect: Effect


@dataclass(frozen=True, slots=True)
class Candidate:
    """An effect that was tried as the first one missing.

    Attributes:
        closure: Explained fraction of the error power above the noise floor; nan where its
            screening ruled it out before a fit.
        gap: Prediction error left, in times the noise floor.
        cosine2: Screening R2.
        sentence: Why it was taken or ruled out.
        probability: Of its family being there, from 0 to 1.
        own_probability: Of itself being there, whatever others of its family are.
    """

    name: str
    closure: float
    gap: float
    cosine2: float
    sentence: str
    probability: float = math.nan
    own_probability: float = math.nan


@dataclass(frozen=True, slots=True)
class BaseParameter:
    """A number of the base model: as given, fitted alone, and fitted with the effects."""

    name: str
    unit: str
    given: float
    base: Interval
    with_effects: Interval


class ModelErrors(NamedTuple):
    """Prediction errors of a model.

    Attributes:
        gap: Short-horizon prediction error, rms, in the unit of the result.
        ratio: That over all channels, in times the noise floor.
        rms: Error of a free run, rms, same unit.
    """

    gap: float
    ratio: float
    rms: float


class HoldOut(NamedTuple):
    """Errors on records that had no part in any fit.

    Attributes:
        floor: Their noise floor, in the unit of the result.
        base: Of the refitted base model.
        with_effects: Of the model with the effects found; those of `base` where there are none.
    """

    records: tuple[str, ...]
    floor: float
    given: ModelErrors
    base: ModelErrors
    with_effects: ModelErrors


@dataclass(frozen=True, slots=True)
class DeclaredEffect:
    """An effect that the model as given has.

    Attributes:
        parameters: Values fitted to the records, by name.
        explained: Share of the error power above the noise floor that it takes off.
    """

    name: str
    title: str
    parameters: Mapping[str, Interval]
    supported: bool
    explained: float
    sentence: str


@dataclass(frozen=True, slots=True)
class SearchStep:
    """Prediction error on data left out after one step of the search.

    Attributes:
        effect: Slug of the effect added; None for the base fit.
        gap: Short-horizon prediction error, rms, in the unit of the result.
        floor: Noise floor, same unit.
        ratio: Prediction error over all channels, in times the noise floor.
    """

    effect: str | None
    gap: float
    floor: float
    ratio: float


@dataclass(frozen=True, slots=True, eq=False)
class Trace:
    """One channel of one record, measured and simulated in free run; arrays (samples,).

    Attributes:
        channel: Its column.
        before: Simulated by the base model.
        after: Simulated with the effects; the same as `before` where there are none.
        title: The channel in words.
    """

    name: str
    channel: str
    unit: str
    time_s: FloatArray
    measured: FloatArray
    before: FloatArray
    after: FloatArray
    title: str


class ModelSummary(NamedTuple):
    """A fitted model, as a verdict is decided from.

    Attributes:
        rank: Place of its effects within their families, summed: less is simpler.
        J: Mean square of the whitened residuals.
        values: Number of values of its effects that are not at a bound.
        eligible: Whether each of its effects is of a size that matters, and not at a bound.
        known_apart: Whether an effect's size is known without the machine.
    """

    names: Slugs
    families: Slugs
    rank: int
    J: float
    values: int
    eligible: bool = True
    named: bool = True
    known_apart: bool = False

    @property
    def power(self) -> float:
        """P, no less than what noise gives."""
        return max(self.J, 1.0)


@dataclass(frozen=True, slots=True)
class Limitation:
    """Something that the records cannot tell.

    Attributes:
        kind: `records_refused`, `tension_below_zero`, `one_direction`, `no_slow_motion`,
            `no_encoder`, `base_parameter_moved` or `base_parameter_at_bound`.
        label: What it is in a few words, for a headline.
        sentence: What it is, and what to do, in plain words without a full stop.
        by_data: Whether it is a fault of the data, not of the motion they show.
    """

    kind: str
    label: str
    sentence: str
    by_data: bool = False


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class DiagnosisResult:
    """Result of a diagnosis.

    Attributes:
        verdict: The conclusion; see `Verdict`.
        sentence: The conclusion in plain words.
        effects: The effects found, in order; for `ambiguous` the best one.
        ambiguous: Slugs the records do not distinguish, best first; empty unless `ambiguous`.
        candidates: All effects tried as the first one, best first.
        unit: Unit of prediction errors: N, or rad, or m of a stage, where no tension was measured.
        given: Errors of the model as given, with nothing but values of single records fitted.
        before: Errors of the refitted base model; of short predictions on data left out.
        floor: Noise floor, same unit.
        where: Localisation of the base model's residual.
        unexplained: That of what the model with the effects leaves.
        calibrations: The base model's numbers and how they shifted.
        not_excited: Effects that these records cannot show, with the reason.
        not_of_the_plant: Those of them that such a plant cannot have.
        next_experiment: The trial that would decide, or None.
        steps: Prediction error on data left out, step by step.
        traces: The records in free run, before and after.
        base_model: The model with its own numbers fitted.
        augmented: `base_model` with the effects, fitted together.
        values: The fit's values by the names of the predictor's free numbers.
        hold_out: Errors on records that had no part in the fits, or None.
        limitations: What these records cannot tell.
        models: Every model that was fitted, the base model first.
        shown_by: The experiment that shows each effect, by slug; empty where none is declared.
        next_recording: What to record next where a question is left and no trial is chosen.
        gains: Gains of the loop that remedies are predicted for: those asked for, or of the last
            closed-loop record that states them.
    """

    verdict: Verdict
    sentence: str
    effects: tuple[NamedEffect, ...]
    ambiguous: tuple[str, ...]
    candidates: tuple[Candidate, ...]
    unit: str
    given: ModelErrors
    before: ModelErrors
    after: ModelErrors
    floor: float
    noise: NoiseFloor
    where: ResidualLocation
    unexplained: ResidualLocation
    calibrations: tuple[BaseParameter, ...]
    not_excited: Mapping[str, str]
    next_experiment: NextExperiment | None
    findings: tuple[DataIssue, ...]
    steps: tuple[SearchStep, ...]
    traces: tuple[Trace, ...]
    model: Any
    base_model: Any
    augmented: Any
    values: Mapping[str, float]
    declared: tuple[DeclaredEffect, ...] = ()
    hold_out: HoldOut | None = None
    limitations: tuple[Limitation, ...] = ()
    models: tuple[ModelSummary, ...] = ()
    shown_by: Mapping[str, str] = field(default_factory=dict)
    not_of_the_plant: frozenset[str] = frozenset()
    next_recording: NextRecording | None = None
    gains: Gains | None = None

    @property
    def hidden(self) -> tuple[str, ...]:
        """Effects that other records of this plant could show."""
        return tuple(name for name in self.not_excited if name not in self.not_of_the_plant)

    @property
    def closure(self) -> float:
        """Explained fraction of the error power above the noise floor; nan without effects."""
        share = explained_share(self.before.ratio**2, self.after.ratio**2)
        return share if self.effects else math.nan

    def remedies(self, gains: Gains | None = None) -> tuple[Offer, ...]:
        """What can be done, each with what it is predicted to bring; see `plants.remedies`.

        Args:
            gains: Gains of the loop; by default `gains`, or else the model's own safe ones.
        """
        return offers_for(self, gains)

    @property
    def ruled_out(self) -> tuple[str, ...]:
        """Sentences on the effects that are not believed."""
        believed = {effect.name for effect in self.effects} | set(self.ambiguous)
        return tuple(f"{c.sentence}." for c in self.candidates if c.name not in believed)

    @property
    def exit_code(self) -> int:
        """Exit code of `estune explain`: `LIMITED`, `FAULTY`, or 0."""
        if any(limit.by_data for limit in self.limitations):
            return FAULTY
        return LIMITED if self.limitations else 0

    @property
    def written_unit(self) -> str:
        """`unit` as it is written: empty for a plant, whose output may be anything."""
        return written_unit(self.unit, self.base_model)
