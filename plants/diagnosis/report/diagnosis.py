"""What a diagnosis says: the verdict, the effects found, and the evidence for them."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, Literal

from estune.core.quantities import FloatArray
from plants.diagnosis.data.measured_record import DataIssue
from plants.diagnosis.data.noise_floor import NoiseFloor
from plants.diagnosis.report.display import DiagnosisDisplay
from plants.diagnosis.residual.localisation import ResidualLocation
from plants.effects import Effect
from plants.effects.plant_scale import written_unit

if TYPE_CHECKING:
    from plants.diagnosis.experiments.next_experiment import NextExperiment

Verdict = Literal["named", "incomplete", "ambiguous", "unknown", "none"]
"""`named`: the effects close the gap; `incomplete`: they close most of it, and more is left than
noise; `ambiguous`: the records cannot tell two effects apart; `unknown`: no declared effect closes
the gap; `none`: there is no gap worth naming."""

Split = Literal["fit", "rank", "report"]


@dataclass(frozen=True, slots=True)
class Interval:
    """A fitted value and its 95 % confidence interval.

    Attributes:
        value: The value.
        low: Lower end, inside the parameter's range.
        high: Upper end.
        unit: Unit of all three; empty for a plain number.
    """

    value: float
    low: float
    high: float
    unit: str

    def over(self, size: float) -> "Interval":
        """The same as a multiple of a size above zero."""
        return replace(self, value=self.value / size, low=self.low / size, high=self.high / size)


@dataclass(frozen=True, slots=True)
class NamedEffect:
    """An effect that was found.

    Attributes:
        name: Its slug.
        title: Its name in plain words.
        parameters: What was fitted, by the parameter's name. Of a plant that is no reel in its
            own units: `input` and `output` are what it is given and what it reads.
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
        name: Its slug.
        closure: Share of the gap's power above the floor that it closes on the rank split, 1 is
            all of it; nan where its score direction ruled it out before a fit.
        gap: What is left on the rank split, in floors.
        cosine2: Share of the residual that its score direction explains on the fit split.
        sentence: Why it was taken or ruled out.
    """

    name: str
    closure: float
    gap: float
    cosine2: float
    sentence: str


@dataclass(frozen=True, slots=True)
class BaseParameter:
    """A number of the base model, as given and as fitted without and with the effects.

    Attributes:
        name: Its name in the model.
        unit: Its unit.
        given: The value in the model as given.
        base: Fitted without any effect.
        with_effects: Fitted together with the effects; the same as `base` where there are none.
    """

    name: str
    unit: str
    given: float
    base: Interval
    with_effects: Interval


@dataclass(frozen=True, slots=True)
class SearchStep:
    """One step of the search: what the gap is on the report split after it.

    Attributes:
        effect: Slug of the effect added; None for the base fit.
        gap: Root mean square of the short-horizon prediction error, in the diagnosis's unit.
        floor: What noise and allowance alone would give, same unit.
        ratio: The gap in floors over all channels, each by its own floor.
    """

    effect: str | None
    gap: float
    floor: float
    ratio: float


@dataclass(frozen=True, slots=True, eq=False)
class Trace:
    """One channel of one record of the report split, measured and predicted in free run.

    Attributes:
        name: The record.
        channel: Its column.
        unit: Its unit.
        time_s: Time of the samples, shape (samples,).
        measured: What was measured, same shape.
        before: The base model's free run, same shape.
        after: That with the effects; the same as `before` where there are none.
    """

    name: str
    channel: str
    unit: str
    time_s: FloatArray
    measured: FloatArray
    before: FloatArray
    after: FloatArray


@dataclass(frozen=True, slots=True)
class DataSegment:
    """A stretch of a record, and what it was used for.

    Attributes:
        record: Name of the record.
        start_s: Its first moment.
        end_s: Its last moment.
        split: `fit`, `rank` or `report`.
    """

    record: str
    start_s: float
    end_s: float
    split: Split


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class Diagnosis(DiagnosisDisplay):
    """The answer of `explain`; it draws itself, and writes itself as a page, text and JSON.

    Attributes:
        verdict: What is said; see `RunSummary`.
        sentence: The same in plain words.
        effects: The effects found, in the order in which they were; for `ambiguous` the best one.
        ambiguous: Slugs the records cannot tell apart, best first; empty unless `ambiguous`.
        candidates: All effects tried as the first one, best first.
        unit: Unit of gaps and floors: N, or rad where no tension was measured; that of the column
            the output is in.
        gap_before: Short-horizon prediction error of the base model on the report split, rms.
        gap_after: The same with the effects.
        floor: What noise and allowance alone would give, same unit.
        ratio_before: `gap_before` in floors over all channels, each by its own floor.
        ratio_after: The same with the effects.
        closure: Share of the gap's power above the floor that was closed, over all channels; nan
            where there is no effect.
        rms_before: Free-run error of the base model on the report split, rms, in `unit`.
        rms_after: The same with the effects.
        noise: The noise of each channel.
        where: Where the base model's residual lives.
        calibrations: The base model's numbers and how they shifted.
        not_excited: Effects that these records cannot show, with the reason.
        ruled_out: What was ruled out and why, one sentence each.
        next_experiment: The trial that would decide, or None.
        findings: What was wrong with the data.
        steps: The gap on the report split, step by step.
        traces: Records of the report split in free run, before and after.
        splits: What each stretch of the data was used for.
        model: The model as given.
        base_model: The model with its calibrations fitted.
        augmented: The same with the effects added; `base_model` where there are none.
        values: The fit's values by the names of the predictor's free numbers.
    """

    verdict: Verdict
    sentence: str
    effects: tuple[NamedEffect, ...]
    ambiguous: tuple[str, ...]
    candidates: tuple[Candidate, ...]
    unit: Literal["N", "rad"]
    gap_before: float
    gap_after: float
    floor: float
    ratio_before: float
    ratio_after: float
    closure: float
    rms_before: float
    rms_after: float
    noise: NoiseFloor
    where: ResidualLocation
    calibrations: tuple[BaseParameter, ...]
    not_excited: Mapping[str, str]
    ruled_out: tuple[str, ...]
    next_experiment: "NextExperiment | None"
    findings: tuple[DataIssue, ...]
    steps: tuple[SearchStep, ...]
    traces: tuple[Trace, ...]
    splits: tuple[DataSegment, ...]
    model: Any
    base_model: Any
    augmented: Any
    values: Mapping[str, float]

    @property
    def written_unit(self) -> str:
        """The same as it is written; see `amounts.written_unit`."""
        return written_unit(self.unit, self.base_model)
