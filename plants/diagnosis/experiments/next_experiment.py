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
from collections.abc import Callable, Mapping, Sequence
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
from plants.diagnosis.prediction.prediction import CHANNELS, Predictor
from plants.diagnosis.residual.localisation import Block, ResidualLocation
from plants.diagnosis.result import NextExperiment, Verdict

SEPARATION_MIN = 0.1
"""Least separation that decides; at it the wrong model's error is 1.05 times the noise floor."""
ANY_GAINS = Gains(1.0, 0.0, 0.0, 0.0)
"""Gains of an open-loop trial have no effect."""


class Evidence(NamedTuple):
    """Evidence of a diagnosis.

    Attributes:
        measurements: The records.
        noise: Their noise.
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
        evidence: The evidence.
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
        described: RigDescription = model.describe("rig", ANY_GAINS)
    except EstuneError:
        return None
    seen = [m.setpoint_N for m in measurements if m.setpoint_N is not None]
    if not seen:
        return None
    low = max(described.limits.tension_min_N, min(float(s.min()) for s in seen))
    high = min(described.limits.tension_max_N, max(float(s.max()) for s in seen))
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
    planned = [_placeholder(one, evidence.measurements, rig) for one in experiments]
    simulated = {
        slug: _predicted(model, planned, evidence.noise) for slug, model in rivals.items()
    }
    # Even the model that simulated a record has a residual: windows begin at a smoothed reading.
    # That much is no difference between models.
    own = {slug: _unfitted(model, simulated[slug], evidence) for slug, model in rivals.items()}
    separation = np.full(len(planned), math.inf)
    for one, other in itertools.permutations(rivals, 2):
        unfitted = _unfitted(rivals[one], simulated[other], evidence) - own[other]
        separation = np.minimum(separation, np.maximum(unfitted, 0.0))
    tried = dict(zip((one.name for one in experiments), separation.tolist(), strict=True))
    best = int(np.argmax(separation))
    if not separation[best] > SEPARATION_MIN:
        return None
    names = " and ".join(rivals)
    return _chosen(
        experiments[best],
        f"{experiments[best].title} distinguishes {names}: they differ by "
        f"{math.sqrt(separation[best]):.2g} sigmas, rms, with all other parameters free",
        float(separation[best]),
        tried,
    )


def _exploring(
    experiments: Sequence[Experiment], base: Any, evidence: Evidence, rig: RigDescription
) -> NextExperiment | None:
    """The experiment that drives the base model furthest where its residual is."""
    block = evidence.where.blocks[0] if evidence.where.blocks else None
    planned = [_placeholder(one, evidence.measurements, rig) for one in experiments]
    predicted = _predicted(base, planned, evidence.noise)
    regime = block.regime.name if block is not None and block.regime is not None else ""
    furthest = np.array([_excited(regime, m) for m in predicted])
    within = np.array([_within(block, m) for m in predicted])
    score = np.sqrt(_share(furthest) * _share(within))
    tried = dict(zip((one.name for one in experiments), score.tolist(), strict=True))
    best = int(np.argmax(score))
    if not score[best] > 0.0:
        return None
    follows = f"in the {regime}, which the error follows" if regime else "where the error is"
    band = f", {block.band}" if block is not None and block.band else ""
    return _chosen(
        experiments[best],
        f"{experiments[best].title} drives the model most {follows}{band}",
        None,
        tried,
    )


def _chosen(
    experiment: Experiment, sentence: str, separation: float | None, tried: Mapping[str, float]
) -> NextExperiment:
    trial = TrialFile(experiment.name, experiment.profile, why=sentence)
    return NextExperiment(trial, sentence, separation, tried)


def _placeholder(
    experiment: Experiment, like: Sequence[MeasuredRecord], rig: RigDescription
) -> MeasuredRecord:
    """The record of an experiment before it is run: outputs are zero."""
    profile, rate = experiment.profile, rig.controller.sampling_Hz
    setpoint = profile.setpoint(rate)
    unknown = {name: np.zeros(setpoint.size) for name in OUTPUTS if _all_have(name, like)}
    return MeasuredRecord(
        name=experiment.name,
        rig=rig.name,
        sampling_Hz=rate,
        cable_length_m=rig.cable_length_m,
        preload_N=profile.preload_N,
        loop=profile.loop,
        profile=profile.kind,
        gains=None,
        time_s=np.arange(setpoint.size) / rate,
        setpoint_N=setpoint,
        current_A=None,
        tension_N=unknown.get("tension_N"),
        angle_rad=unknown.get("angle_rad"),
        reference_N=unknown.get("reference_N"),
        flags=np.zeros(setpoint.size, np.uint8),
    )


def _all_have(name: str, measurements: Sequence[MeasuredRecord]) -> bool:
    return all(m.channel(name) is not None for m in measurements)


def _predicted(
    model: Any, planned: Sequence[MeasuredRecord], noise: NoiseFloor
) -> list[MeasuredRecord]:
    """Simulated records of experiments, without noise, in free run."""
    plant = diagnosed(model, planned)
    predictor = Predictor(plant, (), planned, horizon_s=None, floor=noise)
    records = []
    for m, found in zip(planned, predictor.predict(predictor.start[None]), strict=True):
        columns = {
            name: column[0]
            for name in OUTPUTS
            if m.channel(name) is not None and (column := getattr(found, name)) is not None
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
        mine = index.measurement == n
        sigma = index.sigma[mine]
        form = _form(record, index.channel[mine], evidence)
        weight = 1.0 / np.sqrt(1.0 + (form / sigma) ** 2)
        own, r = slopes[mine] * weight[:, None], residuals[mine] * weight
        scale = np.sqrt((own**2).sum(axis=0))
        own = own[:, scale > 0.0] / scale[scale > 0.0]
        r = r - own @ (np.linalg.pinv(own.T @ own, rcond=1e-9, hermitian=True) @ (own.T @ r))
        unfitted[n] = float(r @ r) / max(r.size, 1)
    return unfitted


def _form(record: MeasuredRecord, channel: Any, evidence: Evidence) -> FloatArray:
    """Expected model-form error of each residual entry, in its unit, shape (entries,)."""
    error = np.zeros(channel.size)
    for number in np.unique(channel).tolist():
        name = CHANNELS[number]
        column = record.channel(name)
        if column is not None:
            error[channel == number] = _form_share(name, evidence) * float(column.std())
    return error


def _form_share(name: str, evidence: Evidence) -> float:
    """Share of a channel's signal that the models do not explain in the records."""
    seen = [c for m in evidence.measurements if (c := m.channel(name)) is not None]
    rms = math.sqrt(sum(float(c.var()) * c.size for c in seen) / sum(c.size for c in seen))
    unexplained = math.sqrt(max(evidence.ratio_after**2 - 1.0, 0.0))
    return unexplained * evidence.noise.effective(name, rms) / rms if rms > 0.0 else 0.0


def _excited(regime: str, m: MeasuredRecord) -> float:
    """Excitation by an experiment of the variable that a residual follows."""
    return _MEASURES.get(regime, _spread_of_rate)(m)


def _output(m: MeasuredRecord) -> FloatArray:
    """The first output there is, shape (samples,)."""
    return next(c for name in OUTPUTS if (c := m.channel(name)) is not None)


def _moving(m: MeasuredRecord) -> FloatArray:
    angle = _output(m) if m.angle_rad is None else m.angle_rad
    return np.gradient(angle, 1.0 / m.sampling_Hz)


def _reversals(m: MeasuredRecord) -> float:
    """Time at low speed in both directions, where friction outweighs inertia."""
    velocity = _moving(m)
    slow = np.abs(velocity) < np.median(np.abs(velocity))
    turns = np.count_nonzero(np.diff(np.sign(velocity[slow])))
    travel = float(np.abs(np.diff(_output(m))).sum())
    return turns * travel / max(float(np.abs(velocity).max()), 1e-300)


def _spread_of_rate(m: MeasuredRecord) -> float:
    return float(_moving(m).std())


def _spread_of_output(m: MeasuredRecord) -> float:
    return float(_output(m).std())


def _spread_of_angle(m: MeasuredRecord) -> float:
    return float(np.ptp(_output(m) if m.angle_rad is None else m.angle_rad))


def _spread_of_command_rate(m: MeasuredRecord) -> float:
    assert m.setpoint_N is not None  # noqa: S101  an experiment has a setpoint
    return float(np.diff(m.setpoint_N).std()) * m.sampling_Hz


def _longest_hold(m: MeasuredRecord) -> float:
    """Longest time without a change of the setpoint, times its distance from the preload."""
    assert m.setpoint_N is not None  # noqa: S101  an experiment has a setpoint
    edges = np.flatnonzero(np.diff(m.setpoint_N, prepend=np.nan, append=np.nan))
    lengths = np.diff(edges)
    held = np.abs(m.setpoint_N[edges[:-1]] - m.preload_N)
    return float((lengths * held).max(initial=0.0))


_MEASURES: Mapping[str, Callable[[MeasuredRecord], float]] = {
    "time": _longest_hold,
    "velocity sign": _reversals,
    "velocity sign and tension": _reversals,
    "velocity": _spread_of_rate,
    "tension": _spread_of_output,
    "angle": _spread_of_angle,
    "position period": _spread_of_angle,
    "command rate": _spread_of_command_rate,
}


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
