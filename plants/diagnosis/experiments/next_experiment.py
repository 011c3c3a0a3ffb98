"""The experiment that decides between effects, or that shows more of an unexplained residual.

Every candidate experiment is simulated with each model that the records do not distinguish. Each
simulation is fitted by the other models, with all their parameters free to first order. The
separation of an experiment is

    min over pairs of mean(((y_i - y_j)/sigma)^2),
    sigma^2 = sigma_n^2 + (0.4 % of the signal's rms)^2 + (c x the signal's rms)^2

where c is the share of the signal that the models do not explain in the records. Without it the
largest amplitude would always win.

An unexplained residual has no models to distinguish: then the experiment is chosen that drives the
base model furthest in the variable that the residual follows, within its frequency band.
"""

import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from estune.core.gains import Gains
from estune.core.quantities import FloatArray
from estune.errors import EstuneError
from estune.run.trial_file import TrialFile
from estune.trial import RigDescription, RigLimits
from estune.trial.profiles import StepProfile
from plants.diagnosis.data.measured_record import OUTPUTS, MeasuredRecord
from plants.diagnosis.data.noise_floor import NoiseFloor
from plants.diagnosis.experiments.designs import WIDEST, Experiment, candidate_experiments
from plants.diagnosis.models.diagnosed_model import DiagnosedModel, diagnosed
from plants.diagnosis.next_data import NextExperiment
from plants.diagnosis.prediction.prediction import CHANNELS, Predictor
from plants.diagnosis.residual.localisation import Block, ResidualLocation
from plants.diagnosis.result import Verdict


class Evidence(NamedTuple):
    """Evidence of a diagnosis.

    Attributes:
        where: Localisation of the base model's residual.
        ratio_after: Prediction error of the best model, in times the noise floor.
    """

    measurements: Sequence[MeasuredRecord]
    noise: NoiseFloor
    where: ResidualLocation
    ratio_after: float


def next_experiment(
    verdict: Verdict,
    base: Any,
    rivals: Mapping[str, Any],
    evidence: Evidence,
    rig: RigDescription | None = None,
) -> NextExperiment | None:
    """The experiment to be run next, or None where none would help.

    Args:
        verdict: The verdict; only `ambiguous` and `unknown` leave a question.
        base: The base model with its parameters fitted.
        rivals: The models that the records do not distinguish, by effect.
        rig: Description of the rig; None derives one from the records and the model.
    """
    if verdict not in ("ambiguous", "unknown"):
        return None
    rig = rig or rig_of(base, evidence.measurements)
    experiments = [] if rig is None else candidate_experiments(rig)
    if not experiments or rig is None:
        return None
    if verdict == "ambiguous" and len(rivals) > 1:
        return _deciding(experiments, rivals, evidence, rig)
    return _exploring(experiments, base, evidence, rig)


def rig_of(model: Any, measurements: Sequence[MeasuredRecord]) -> RigDescription | None:
    """Description of a rig from its model and its records, limited to their setpoints.

    None where the model is no plant, or the records have no setpoint.
    """
    if not hasattr(model, "describe"):
        return None
    try:
        # Gains of an open-loop trial have no effect.
        described: RigDescription = model.describe("rig", Gains(1.0, 0.0, 0.0, 0.0))
    except EstuneError:
        return None
    setpoints = [m.setpoint_N for m in measurements if m.setpoint_N is not None]
    if not setpoints:
        return None
    low = max(described.limits.tension_min_N, min(float(s.min()) for s in setpoints))
    high = min(described.limits.tension_max_N, max(float(s.max()) for s in setpoints))
    if not low < high:
        return None
    middle = 0.5 * (low + high)
    half_step = (high - low) / WIDEST / 2.0
    first = measurements[0]
    return replace(
        described,
        limits=RigLimits(low, high, described.limits.duration_max_s),
        step=StepProfile(middle - half_step, 2.0 * half_step, 0.2, 1.0, described.step.loop),
        controller=replace(described.controller, sampling_Hz=first.sampling_Hz),
        cable_length_m=first.cable_length_m,
    )


def _deciding(
    experiments: Sequence[Experiment],
    rivals: Mapping[str, Any],
    evidence: Evidence,
    rig: RigDescription,
) -> NextExperiment | None:
    """The experiment in which the least distinct pair of models differs most."""
    planned = [_placeholder(each, evidence.measurements, rig) for each in experiments]
    simulated = {
        slug: _predicted(model, planned, evidence.noise) for slug, model in rivals.items()
    }
    # Even the model that simulated a record has a residual: windows begin at a smoothed reading.
    # That much is no difference between models.
    unfitted_own = {
        slug: _unfitted(model, simulated[slug], evidence) for slug, model in rivals.items()
    }
    separation = np.full(len(planned), math.inf)
    for slug, true_slug in itertools.permutations(rivals, 2):
        unfitted = (
            _unfitted(rivals[slug], simulated[true_slug], evidence) - unfitted_own[true_slug]
        )
        separation = np.minimum(separation, np.maximum(unfitted, 0.0))
    most = float(separation.max())
    why = (
        f"distinguishes {' and '.join(rivals)}: they differ by {math.sqrt(most):.2g} sigmas, rms, "
        "with all other parameters free"
    )
    # At 0.1 the wrong model's error is 1.05 times the noise floor.
    best = _best(experiments, separation, 0.1, why)
    return best and replace(best, separation=most)


def _exploring(
    experiments: Sequence[Experiment], base: Any, evidence: Evidence, rig: RigDescription
) -> NextExperiment | None:
    """The experiment that drives the base model furthest where its residual is."""
    block = evidence.where.blocks[0] if evidence.where.blocks else None
    planned = [_placeholder(experiment, evidence.measurements, rig) for experiment in experiments]
    predicted = _predicted(base, planned, evidence.noise)
    regime = block.regime.name if block is not None and block.regime is not None else ""
    furthest = np.array([_excited(regime, m) for m in predicted])
    within = np.array([_within(block, m) for m in predicted])
    follows = f"in the {regime}, which the error follows" if regime else "where the error is"
    band = f", {block.band}" if block is not None and block.band else ""
    score = np.sqrt(_share(furthest) * _share(within))
    return _best(experiments, score, 0.0, f"drives the model most {follows}{band}")


def _best(
    experiments: Sequence[Experiment], score: FloatArray, least: float, why: str
) -> NextExperiment | None:
    n = int(np.argmax(score))
    if not score[n] > least:
        return None
    experiment, sentence = experiments[n], f"{experiments[n].title} {why}"
    tried = dict(zip((e.name for e in experiments), score.tolist(), strict=True))
    trial = TrialFile(experiment.name, experiment.profile, why=sentence)
    return NextExperiment(trial, sentence, None, tried)


def _placeholder(
    experiment: Experiment, like: Sequence[MeasuredRecord], rig: RigDescription
) -> MeasuredRecord:
    profile, rate = experiment.profile, rig.controller.sampling_Hz
    setpoint = profile.setpoint(rate)
    blank: list[FloatArray | None] = [
        np.zeros(setpoint.size) if all(m.channel(name) is not None for m in like) else None
        for name in OUTPUTS
    ]
    return MeasuredRecord(
        name=experiment.name,
        rig=rig.name,
        sampling_Hz=rate,
        cable_length_m=rig.cable_length_m,
        preload_N=profile.preload_N,
        loop=profile.loop,
        profile=profile.kind,
        time_s=np.arange(setpoint.size) / rate,
        setpoint_N=setpoint,
        tension_N=blank[0],
        angle_rad=blank[1],
        reference_N=blank[2],
    )


def _predicted(
    model: Any, planned: Sequence[MeasuredRecord], noise: NoiseFloor
) -> list[MeasuredRecord]:
    """Simulated records of experiments, without noise, in free run."""
    plant = diagnosed(model, planned)
    predictor = Predictor(plant, (), planned, horizon_s=None, floor=noise)
    records = []
    for m, prediction in zip(planned, predictor.predict(predictor.start[None]), strict=True):
        columns = {
            name: column[0]
            for name in OUTPUTS
            if m.channel(name) is not None and (column := getattr(prediction, name)) is not None
        }
        records.append(replace(m, **columns))
    return records


def _unfitted(model: Any, records: Sequence[MeasuredRecord], evidence: Evidence) -> FloatArray:
    """Mean square residual of each record after a linearised fit, in variances, (records,)."""
    plant: DiagnosedModel = diagnosed(model, records)
    predictor = Predictor(plant, (), records, floor=evidence.noise)
    residuals, slopes = predictor.linearise(predictor.start)
    index = predictor.index
    unfitted = np.zeros(len(records))
    for n, record in enumerate(records):
        of_record = index.measurement == n
        form = np.zeros(len(CHANNELS))  # expected model-form error of each channel
        for number in np.unique(index.channel[of_record]):
            name = CHANNELS[number]
            form[number] = _form_share(name, evidence) * float(
                np.std(np.asarray(record.channel(name)))
            )
        weight = 1.0 / np.sqrt(
            1.0 + (form[index.channel[of_record]] / index.sigma[of_record]) ** 2
        )
        slope, r = slopes[of_record] * weight[:, None], residuals[of_record] * weight
        scale = np.sqrt((slope**2).sum(axis=0))
        slope = slope[:, scale > 0.0] / scale[scale > 0.0]
        r = r - slope @ (
            np.linalg.pinv(slope.T @ slope, rcond=1e-9, hermitian=True) @ (slope.T @ r)
        )
        unfitted[n] = float(r @ r) / max(r.size, 1)
    return unfitted


def _form_share(name: str, evidence: Evidence) -> float:
    """Share of a channel's signal that the models do not explain in the records."""
    columns = [c for m in evidence.measurements if (c := m.channel(name)) is not None]
    rms = math.sqrt(sum(float(c.var()) * c.size for c in columns) / sum(c.size for c in columns))
    unexplained = math.sqrt(max(evidence.ratio_after**2 - 1.0, 0.0))
    return unexplained * evidence.noise.effective(name, rms) / rms if rms > 0.0 else 0.0


def _excited(regime: str, m: MeasuredRecord) -> float:
    """How far an experiment excites the variable that a residual follows."""
    output, command = _output(m), np.asarray(m.setpoint_N)
    angle = output if m.angle_rad is None else m.angle_rad
    velocity = np.gradient(angle, 1.0 / m.sampling_Hz)
    match regime:
        case "time":  # the longest hold, times its distance from the preload
            edges = np.flatnonzero(np.diff(command, prepend=np.nan, append=np.nan))
            held = np.abs(command[edges[:-1]] - m.preload_N)
            return float((np.diff(edges) * held).max(initial=0.0))
        case "velocity sign" | "velocity sign and tension" | "velocity sign and load":
            # Slow travel in both directions, where friction outweighs inertia.
            slow = np.abs(velocity) < np.median(np.abs(velocity))
            turns = np.count_nonzero(np.diff(np.sign(velocity[slow])))
            travel = float(np.abs(np.diff(output)).sum())
            return turns * travel / max(float(np.abs(velocity).max()), 1e-300)
        case "tension" | "load":
            return float(output.std())
        case "angle" | "position period":
            return float(np.ptp(angle))
        case "command rate" | "frequency":
            return float(np.diff(command).std()) * m.sampling_Hz
        case _:
            return float(velocity.std())


def _output(m: MeasuredRecord) -> FloatArray:
    return next(c for name in OUTPUTS if (c := m.channel(name)) is not None)


def _within(block: Block | None, m: MeasuredRecord) -> float:
    """Root mean square of an experiment's output inside the band of a block."""
    output = _output(m) - _output(m).mean()
    if block is None or not block.high_Hz > 0.0:
        return float(output.std())
    spectrum: FloatArray = np.abs(np.fft.rfft(output)) ** 2
    frequency = np.fft.rfftfreq(output.size, 1.0 / m.sampling_Hz)
    inside = (frequency >= block.low_Hz) & (frequency <= block.high_Hz)
    power = float(spectrum[inside].sum())
    return math.sqrt(2.0 * power) / float(output.size)


def _share(values: FloatArray) -> FloatArray:
    """Values relative to the greatest, 0 where none is above zero."""
    finite = np.where(np.isfinite(values), values, 0.0)
    greatest = float(finite.max(initial=0.0))
    shares: FloatArray = finite / greatest if greatest > 0.0 else finite
    return shares
