"""Result of improving a rig's model: the rounds, the model, predicted and measured costs."""

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

from estune.core.gains import GAIN_NAMES, Gains
from estune.run.results.result import TuneResult
from estune.support.notebook_card import card
from estune.trial import RigDescription
from plants.diagnosis.constants import CONSTANTS
from plants.diagnosis.report.diagnosis import Diagnosis
from plants.diagnosis.report.json_form import finite_json
from plants.diagnosis.report.summary import TextTable

COLUMNS = ("gains", "model as given", "improved model", "measured")
OWN, REACHED, TUNED = "the rig's own", "reached with the model", "tuned on the rig"
"""Which gains a cost is of."""


class ImprovementRound(NamedTuple):
    """One diagnosis of the loop.

    Attributes:
        experiments: Names of the experiments run since the round before; none where all records
            were explained anew.
    """

    experiments: tuple[str, ...]
    diagnosis: Diagnosis


@dataclass(frozen=True, slots=True)
class Costs:
    """Predicted and measured cost (35) of one set of gains.

    Attributes:
        label: Which gains they are.
        given: Prediction of the model as given; nan where the predicted trial diverges.
        measured: Mean over repeats on the rig; nan where a trial failed.
        error: Standard error of that mean.
    """

    label: str
    gains: Gains
    given: float
    improved: float
    measured: float
    error: float

    @property
    def error_given(self) -> float:
        """Relative error of the cost predicted by the model as given."""
        return abs(self.given / self.measured - 1.0)

    @property
    def error_improved(self) -> float:
        """Relative error of the cost predicted by the improved model."""
        return abs(self.improved / self.measured - 1.0)


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class Improvement:
    """A rig's model before and after, and the tuning done with it.

    Attributes:
        rig: The rig; its live gains have not been changed.
        given: The model as given, at the rig's cable length and preload.
        rounds: Each diagnosis, the first of the initial experiments alone.
        costs: At the rig's own gains, at those tuned on the model, and at those tuned on the rig
            from there; empty where there is nothing to be controlled.
        folder: Records, trial files, the run of the tuning.
    """

    rig: RigDescription
    given: Any
    model: Any
    rounds: tuple[ImprovementRound, ...]
    costs: tuple[Costs, ...]
    tuning: TuneResult | None
    remarks: tuple[str, ...]
    folder: Path

    @property
    def diagnosis(self) -> Diagnosis:
        """The last diagnosis."""
        return self.rounds[-1].diagnosis

    @property
    def added(self) -> tuple[str, ...]:
        """Slugs of the effects that were added to the model, in order."""
        had = [type(effect).name for effect in getattr(self.given, "effects", ())]
        now = [type(effect).name for effect in getattr(self.model, "effects", ())]
        return tuple(name for name in now if name not in (*had, "calibration"))

    def heading(self) -> str:
        """The effects added and the last verdict in one line."""
        names = ", ".join(self.added) or "no effect"
        return f"{self.rig.name}: {names} added; then {self.diagnosis.heading()}"

    @property
    def conclusion(self) -> str:
        """What model and tuning brought, by measured costs; empty where nothing was tuned."""
        if not self.costs:
            return ""
        by_label = {costs.label: costs for costs in self.costs}
        own, reached = by_label[OWN], by_label.get(REACHED, by_label[OWN])
        tuned = by_label.get(TUNED)
        if reached is own:
            gained = "no gains of the model could be reached from the rig's own"
        elif (
            reached.measured + CONSTANTS.quantile * math.hypot(own.error, reached.error)
            < own.measured
        ):
            gained = f"the model's gains cut the measured cost by {_cut(own, reached)}"
        else:
            gained = "the model's gains do not cut the measured cost beyond its error"
        if tuned is None:
            return f"{gained}; tuning on the rig found nothing better"
        return f"{gained}; tuning on the rig cut it by {_cut(own, tuned)} in all"

    def rows(self) -> tuple[tuple[str, ...], ...]:
        """The costs as the cells of a table with `COLUMNS`."""
        return tuple(
            (
                costs.label,
                _cell(costs.given, costs.error_given),
                _cell(costs.improved, costs.error_improved),
                f"{costs.measured:.4g} ± {costs.error:.2g}",
            )
            for costs in self.costs
        )

    def _repr_html_(self) -> str:
        return card(
            self.heading(),
            good=self.diagnosis.verdict in {"named", "none"},
            tables=[(COLUMNS, *self.rows())] if self.costs else [],
            sentences=tuple(filter(None, (*self.remarks, self.conclusion))),
        )

    def __repr__(self) -> str:
        lines = [self.heading()]
        for n, round_ in enumerate(self.rounds, 1):
            names = ", ".join(round_.experiments) or "all records anew"
            lines.append(f"round {n} ({names}): {round_.diagnosis.heading()}")
        if self.costs:
            lines += TextTable(COLUMNS, self.rows()).lines()
        return "\n".join(filter(None, [*lines, *self.remarks, self.conclusion]))

    def to_json(self) -> dict[str, Any]:
        """JSON values; numbers that are not finite are null."""
        whole = {
            "rig": self.rig.name,
            "effects": list(self.added),
            "verdict": self.diagnosis.verdict,
            "rounds": [
                {"experiments": list(round_.experiments), "diagnosis": round_.diagnosis.to_json()}
                for round_ in self.rounds
            ],
            "costs": [
                {
                    "label": c.label,
                    "gains": {name: getattr(c.gains, name) for name in GAIN_NAMES},
                    "given": c.given,
                    "improved": c.improved,
                    "measured": c.measured,
                    "measured_error": c.error,
                }
                for c in self.costs
            ],
            "tuned": self.tuning is not None and self.tuning.success,
            "remarks": list(self.remarks),
            "conclusion": self.conclusion,
            "folder": str(self.folder),
        }
        return {key: finite_json(value) for key, value in whole.items()}


def _cut(before: Costs, after: Costs) -> str:
    return f"{1.0 - after.measured / before.measured:.0%}".replace("%", " %")


def _cell(predicted: float, error: float) -> str:
    if not math.isfinite(predicted):
        return "diverges"
    return f"{predicted:.4g} ({error:.0%} off)" if math.isfinite(error) else f"{predicted:.4g}"
