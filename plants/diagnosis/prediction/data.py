"""Prediction data: command, windows, initial states and measured entries of some records."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from estune.core.quantities import FloatArray
from estune.trial import GUARD, LATE
from plants.diagnosis.constants import CONSTANTS
from plants.diagnosis.data.measured_record import MeasuredRecord
from plants.diagnosis.data.noise_floor import NoiseFloor, noise_floor, unrepeated
from plants.diagnosis.models.diagnosed_model import DiagnosedModel
from plants.diagnosis.models.initial_states import estimate_states
from plants.diagnosis.prediction.library import CHANNELS
from plants.diagnosis.prediction.window_projection import WindowProjection


class Index(NamedTuple):
    """Description of each entry of the residuals; all of shape (entries,).

    Attributes:
        sigma: Divisor of the entry, sigma_eff in the channel's unit.
        window: Index of the window, counted through all measurements.
    """

    measurement: NDArray[np.int32]
    channel: NDArray[np.int32]
    sample: NDArray[np.int32]
    time_s: FloatArray
    sigma: FloatArray
    window: NDArray[np.int32]


@dataclass(frozen=True, slots=True, eq=False)
class PredictionData:
    """Concatenated records, independent of the candidate effects.

    Attributes:
        preload: Tension at which a record's constants are taken.
        reading: Reading at rest with which each record begins.
        command: Effort, N.
        windows: Number of windows of each record at whose start the state is reset.
        window_at: First sample of each, in its record.
        window_place: State there, shape (windows, placed).
        measured: Measured value of each residual entry.
        source: Index of its prediction among the channels, those of one record after another.
        block_end: Entry after the last of each window.
    """

    measurements: tuple[MeasuredRecord, ...]
    record_samples: NDArray[np.int64]
    preload: FloatArray
    reading: FloatArray
    command: FloatArray
    windows: NDArray[np.int64]
    window_at: NDArray[np.int64]
    window_place: FloatArray
    measured: FloatArray
    source: NDArray[np.int64]
    block_end: NDArray[np.int64]
    record_blocks: NDArray[np.int64]
    index: Index


def prepare_data(
    model: DiagnosedModel,
    measurements: tuple[MeasuredRecord, ...],
    horizon_s: float | None,
    floor: NoiseFloor | None,
    placed: int,
) -> PredictionData:
    """The prediction data of some records; `placed` states are reset, none without a horizon."""
    noise = noise_floor(measurements) if floor is None else floor
    starts = [_start(model, m, horizon_s, noise, placed) for m in measurements]
    measured, source, block_end, index = _entries(model, measurements, starts, noise)
    return PredictionData(
        measurements=measurements,
        record_samples=np.array([m.samples for m in measurements], np.int64),
        preload=np.array([model.preload(m) for m in measurements], np.float64),
        reading=np.array([start.reading for start in starts], np.float64),
        command=np.concatenate([model.command_N(m) for m in measurements]),
        windows=np.array([len(start.placed) for start in starts], np.int64),
        window_at=np.concatenate([start.edges[: len(start.placed)] for start in starts]),
        window_place=np.concatenate([start.placed for start in starts]),
        measured=measured,
        source=source,
        block_end=block_end,
        record_blocks=np.array([start.edges.size for start in starts], np.int64),
        index=index,
    )


def with_window_sigma(
    of: PredictionData, floor: NoiseFloor | None, basis: FloatArray
) -> PredictionData:
    """The data with sigma for predictions over windows.

    The allowance is a share of the signal that initial states do not explain: a plant that
    integrates travels far. Disturbance forces move it further in a window than its encoder's
    steps; repeated commands show how far. (In a gauge, what does not repeat may be mains
    interference, which can be explained.) Noise of a speed that was integrated adds up: e steps
    by n_k in each sample, so that of e = S n, S lower triangular of ones, initial states of basis
    B leave the mean square |S|^2 - |S^T B|^2 in a window.

    Args:
        of: Data whose allowance is a share of each whole signal.
        floor: The noise; None estimates it.
        basis: Responses to initial states, orthonormal, shape (placed, entries).
    """
    noise = noise_floor(of.measurements) if floor is None else floor
    index, blocks = of.index, WindowProjection(of.block_end)
    number = index.measurement * len(CHANNELS) + index.channel
    kinds = len(of.measurements) * len(CHANNELS)
    count = np.maximum(np.bincount(number, minlength=kinds), 1)
    centred = of.measured - (np.bincount(number, of.measured, kinds) / count)[number]
    unexplained = blocks.residual_after(centred / index.sigma, basis) * index.sigma
    spread = np.sqrt(np.bincount(number, unexplained * unexplained, kinds) / count)
    largest = np.zeros(kinds)
    np.maximum.at(largest, number, np.abs(of.measured))
    angle = CHANNELS.index("angle_rad")
    walked = 0.0 if "angle_rad" not in noise.channels else noise.channels["angle_rad"].walk
    if walked:
        walked *= _walked(index.channel == angle, blocks, basis)
    least = {"angle_rad": max(_unrepeated_rms(of, blocks, basis, angle), walked)}
    sigma = np.array(
        [
            _sigma(noise, name, float(spread[n]), float(largest[n]), least.get(name, 0.0))
            for n, name in enumerate(CHANNELS * len(of.measurements))
        ]
    )
    return replace(of, index=index._replace(sigma=sigma[number]))


def _unrepeated_rms(
    of: PredictionData, blocks: WindowProjection, basis: FloatArray, channel: int
) -> float:
    """Rms of a channel that repeated commands do not reproduce in windows; 0 without repeats."""
    index, repeats = of.index, unrepeated(of.measurements)
    # A current does not depend on the initial state: its deviations are not needed.
    deviation = np.where(index.channel == CHANNELS.index("current_A"), 0.0, np.nan)
    for n, columns in enumerate(repeats):
        for name, column in columns.items():
            at = (index.measurement == n) & (index.channel == CHANNELS.index(name))
            deviation[at] = column[index.sample[at]]
    whole = np.bincount(index.window, ~np.isfinite(deviation))[index.window] == 0
    deviation[~whole] = 0.0
    unexplained = blocks.residual_after(deviation / index.sigma, basis) * index.sigma
    chosen = whole & (index.channel == channel)
    if not chosen.any():
        return 0.0
    windows = np.unique(index.window[chosen])
    square = np.bincount(index.window[chosen], unexplained[chosen] ** 2)[windows]
    square /= np.bincount(index.window[chosen])[windows]
    # A few impacts must not raise the noise floor.
    return float(np.sqrt(np.minimum(square, 5.0 * np.median(square)).mean()))


def _walked(of_angle: NDArray[np.bool_], blocks: WindowProjection, basis: FloatArray) -> float:
    """Rms in windows of a sum of steps of one, without what initial states explain of it."""
    chosen = of_angle.astype(np.float64)
    by_states = sum(float(np.square(blocks.later_sums(chosen * b)).sum()) for b in basis)
    left = float(blocks.later_sums(chosen).sum()) - by_states
    return float(np.sqrt(max(left, 0.0) / max(chosen.sum(), 1.0)))


class _Start(NamedTuple):
    """Initial state of one record: reading at rest, first samples of windows, states there."""

    reading: float
    edges: NDArray[np.int64]
    placed: FloatArray


def _start(
    model: DiagnosedModel,
    m: MeasuredRecord,
    horizon_s: float | None,
    noise: NoiseFloor,
    placed: int,
) -> _Start:
    edges = np.zeros(1, np.int64)
    output = None if model.placed_by is None else m.channel(model.placed_by)
    if output is None:  # the state is not observable
        return _Start(_reading(model, m, noise), edges, np.empty((0, placed)))
    if horizon_s is not None:
        window = max(round(horizon_s * m.sampling_Hz), 2)
        edges = np.arange(max(m.samples // window, 1), dtype=np.int64) * window
    states = estimate_states(
        *(model.local(m), np.nan_to_num(output), m.sampling_Hz),
        *(noise.rms(model.placed_by or ""), edges),
    )
    reading = _reading(model, m, noise)
    if horizon_s is None and _rests(model, m, states.placed[0], states.deviation, noise):
        at_rest = np.append(output[:1], np.zeros(placed - 1))[None]
        stands_anywhere = model.output == "rad" and "tension_N" not in model.outputs
        return _Start(reading, edges, at_rest if stands_anywhere else np.empty((0, placed)))
    return _Start(reading, edges, states.placed)


def _rests(
    model: DiagnosedModel,
    m: MeasuredRecord,
    placed: FloatArray,
    deviation: FloatArray,
    noise: NoiseFloor,
) -> bool:
    output = m.channel(model.placed_by or "")
    if output is None:
        return True
    rates = np.abs(placed[1:])
    typical, strict = np.std(np.diff(output)) * m.sampling_Hz, CONSTANTS.clear * deviation[1:]
    if rates.size and rates[0] > strict[0] + CONSTANTS.small * typical:
        return False
    tension = m.tension_N
    if tension is None:
        return True
    off = abs(float(tension[0]) - m.preload_N)
    begins = off <= CONSTANTS.clear * noise.tension_N + 1e-6 * float(np.ptp(tension))
    return begins or bool(rates.size and rates[0] <= strict[0])


def _reading(model: DiagnosedModel, m: MeasuredRecord, noise: NoiseFloor) -> float:
    """Reading of the gauge at a record's start: the preload, unless the readings contradict it."""
    tension = m.tension_N
    if tension is None:
        # A drum without a cable stands where it is.
        return model.preload(m) if "tension_N" in model.outputs else 0.0
    first = tension[:8]
    mean = float(first[np.isfinite(first)].mean()) if np.isfinite(first).any() else m.preload_N
    close = CONSTANTS.clear * noise.tension_N / np.sqrt(first.size)
    # An excitation may begin with the record, and mains interference may be on it.
    close += float(np.ptp(first[np.isfinite(first)])) if np.isfinite(first).any() else 0.0
    return m.preload_N if abs(mean - m.preload_N) <= close else mean


def _entries(
    model: DiagnosedModel,
    measurements: Sequence[MeasuredRecord],
    starts: Sequence[_Start],
    noise: NoiseFloor,
) -> tuple[FloatArray, NDArray[np.int64], NDArray[np.int64], Index]:
    """Measured values, indices of the predictions, ends of the windows, description.

    Residual entries go by record, by window, then by channel.
    """
    windows_entries, ends, first, window = [], [0], 0, 0
    for record, (m, start) in enumerate(zip(measurements, starts, strict=True)):
        columns = _columns(m, model, noise)
        ok = np.ones(m.samples, bool) if m.flags is None else (m.flags & (GUARD | LATE)) == 0
        for begin, end in zip(start.edges, [*start.edges[1:], m.samples], strict=True):
            ends.append(ends[-1])
            for channel, (column, sigma) in columns.items():
                kept = begin + np.flatnonzero(ok[begin:end] & np.isfinite(column[begin:end]))
                entries = np.empty((7, kept.size))
                entries[:3] = (
                    column[kept],
                    len(CHANNELS) * first + channel * m.samples + kept,
                    kept,
                )
                entries[3:] = np.array([[record], [channel], [window], [sigma]])
                windows_entries.append(entries)
                ends[-1] += kept.size
            window += 1
        first += m.samples
    measured, source, sample, *labels, sigma = np.concatenate(windows_entries, axis=1)
    record, channel, number = (label.astype(np.int32) for label in labels)
    place = sample.astype(np.int32)
    times = np.concatenate([m.time_s for m in measurements])
    begins = np.cumsum([0, *(m.samples for m in measurements)])
    index = Index(record, channel, place, times[begins[record] + place], sigma, number)
    return measured, source.astype(np.int64), np.array(ends[1:], np.int64), index


def _columns(
    m: MeasuredRecord, model: DiagnosedModel, noise: NoiseFloor
) -> dict[int, tuple[FloatArray, float]]:
    columns = {}
    for number, name in enumerate(CHANNELS):
        column = m.channel(name) if name in model.outputs else None
        if name == "current_A":
            column = _without_lag(m, model.newtons_per_ampere)
        if column is not None:
            spread, largest = float(np.nanstd(column)), float(np.nanmax(np.abs(column)))
            columns[number] = column, _sigma(noise, name, spread, largest)
    return columns


def _sigma(
    noise: NoiseFloor, channel: str, spread: float, largest: float, known: float = 0.0
) -> float:
    """Sigma_eff of a channel, from the rms to explain, the largest reading and known noise."""
    least = 1e-9 * max(spread, largest, 1e-3)
    return float(np.fmax(noise.effective(channel, spread, known), least))


def _without_lag(m: MeasuredRecord, newtons_per_ampere: float) -> FloatArray | None:
    """A measured current, aligned with the command.

    Its filter and place between command and motor are not known: its lag says nothing about the
    dead time.
    """
    current = m.measured_current_A(newtons_per_ampere)
    if current is None:
        return None
    command = m.command_A(newtons_per_ampere)
    most = min(20, m.samples // 4)  # lags in samples: 50 ms at 400 Hz, and no time of its own
    kept = m.samples - most
    before = np.concatenate([command[:1], command[:-1]])
    columns = np.stack([command, before - command, np.ones(m.samples)], axis=1)
    fits = [_shares(columns[:kept], current[lag : lag + kept]) for lag in range(most + 1)]
    # A slow command leaves the lag open: then the least that fits as well. A lag too short by a
    # sample fits as well through the previous command, which is then the larger share.
    squares = np.array([square for _, square in fits])
    tolerance = 1.05
    well = squares <= tolerance * squares.min()
    near = np.array([2.0 * abs(previous) <= abs(gain) for (gain, previous, *_), _ in fits])
    lag = int(np.argmax(well & near)) if (well & near).any() else int(np.argmax(well))
    moved = np.full(current.size, np.nan)
    moved[: current.size - lag] = current[lag:]
    # The fraction of a sample in the lag shows as a share of the previous command.
    _, whole = _shares(columns[:kept, [0, 2]], current[lag : lag + kept])
    if whole > tolerance * squares[lag]:
        moved -= fits[lag][0][1] * columns[:, 1]
    return moved


def _shares(columns: FloatArray, current: FloatArray) -> tuple[FloatArray, float]:
    """The least-squares shares of the columns in the current, and the sum of squares left."""
    shares = np.asarray(np.linalg.lstsq(columns, current, rcond=None)[0], np.float64)
    residual = current - columns @ shares
    return shares, float(np.sum(residual**2))
