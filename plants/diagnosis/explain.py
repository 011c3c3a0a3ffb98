"""Identification of the effect that a model lacks, from records, in one call."""

from collections.abc import Sequence
from typing import Any

from estune.recordings.column_map import AS_NAMED, ColumnMap
from estune.support.blas import one_blas_thread
from estune.trial import RigDescription
from plants.diagnosis.data.noise_floor import noise_floor
from plants.diagnosis.data.records import Records, read
from plants.diagnosis.models.diagnosed_model import diagnosed
from plants.diagnosis.pipeline.check import check
from plants.diagnosis.pipeline.compare import compare
from plants.diagnosis.pipeline.fit import fit
from plants.diagnosis.pipeline.intervals import intervals
from plants.diagnosis.pipeline.report import report
from plants.diagnosis.pipeline.screen import screen
from plants.diagnosis.progress import Progress, portion, silent
from plants.diagnosis.report.diagnosis import Diagnosis
from plants.diagnosis.search.effect_choices import EffectChoices
from plants.effects import Effect


def explain(
    model: Any,
    records: Records,
    *,
    effects: Sequence[type[Effect] | str] | None = None,
    rig: RigDescription | None = None,
    columns: ColumnMap = AS_NAMED,
    hold_out: Records | None = None,
    progress: Progress = silent,
) -> Diagnosis:
    """Identifies the effect that a model lacks, from records; deterministic.

    Args:
        model: A `Reel`, an `UnloadedReel`, a linear or a Python plant, or a system of
            python-control.
        records: A folder of records, or the records themselves.
        effects: The effects to choose from, classes or names for `plants.effects.find`; None is
            all that are declared, those of other packages included.
        rig: The rig of the next experiment; None derives it from the records.
        columns: Where the columns come from, in files that name them otherwise.
        hold_out: Records that no model is fitted to; the errors on them are reported.
        progress: Called with the phase in words and the estimated share of the work that is done,
            0 to 1, in the caller's thread: as each phase begins and after each candidate effect.

    Raises:
        InvalidInput: there is no record that can be used; the message says why for each.
        PlantError: the model cannot be simulated.
    """
    with one_blas_thread():
        progress("reading the records", 0.0)
        logged = read(records, model, columns)
        logged_aside = None if hold_out is None else read(hold_out, model, columns)

        progress("checking the records", 0.02)
        usable = check(logged, model)
        aside = () if logged_aside is None else check(logged_aside, model).measurements

        progress("estimating the noise", 0.05)
        sensor_noise = noise_floor(usable.measurements)

        progress("fitting the model as given", 0.08)
        plant = diagnosed(model, usable.measurements)
        fitted = fit(plant, sensor_noise, EffectChoices.of(plant, effects))

        progress("screening effects", 0.15)
        screening = screen(fitted)

        compared = compare(usable, fitted, screening, aside, portion(progress, 0.2, 0.9))

        progress("working out intervals", 0.9)
        stated = intervals(compared)

        progress("writing the report", 0.92)
        held_out = plant.for_records(aside) if aside else None
        diagnosis = report(model, usable, compared, stated, held_out=held_out, rig=rig)
        progress("done", 1.0)
        return diagnosis
