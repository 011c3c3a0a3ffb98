"""What a trial does to the setpoint: a step, or an excitation that shows what a model lacks.

A profile is a few numbers and a formula, so that a request stays small and a small board can
compute the setpoint itself. In all formulas k is the sample from 0, f_s the sampling rate,
t = k/f_s and s = t - start_s; before `start_s` the setpoint is the preload.

In a closed loop the setpoint is followed by the controller. In an open loop it goes straight to
the current loop: current = setpoint / newtons per ampere, within the rig's limits of effort.
"""

import math
from dataclasses import dataclass, fields
from functools import lru_cache
from typing import Annotated, Any, Literal, TypeAlias, get_args

import numpy as np
from numpy.typing import NDArray

from estune.errors import InvalidInput

FloatArray = NDArray[np.float64]

Loop = Literal["closed", "open"]
Lines = Literal["all", "odd", "odd_sparse"]
Kind = Literal["step", "triangle", "multisine", "chirp", "staircase"]

ODD_GROUP = 4
"""Of so many odd lines `odd_sparse` leaves one out."""
GOLDEN = (math.sqrt(5.0) - 1.0) / 2.0
PEAK_SAMPLES = 16
"""Samples in a period of the highest line, where the peak of a multisine is looked for."""
ROUNDING = 1e-9
"""Share of a sample or a stair by which a time may miss its start and still count as its start."""
MOST_LINES = 2000
STEEPEST = 4.0


class _Sampled:
    """What a profile's length in samples follows from."""

    __slots__ = ()
    duration_s: float

    def samples(self, sampling_Hz: float) -> int:
        """Number of samples in a trial."""
        return round(self.duration_s * sampling_Hz)


class _Excitation(_Sampled):
    """A profile that begins at `start_s`."""

    __slots__ = ()
    start_s: float

    def _since_start(self, sampling_Hz: float) -> FloatArray:
        """The time s at each sample; a rounding error before the start is at it."""
        s = np.arange(self.samples(sampling_Hz)) / sampling_Hz - self.start_s
        s[np.abs(s) * sampling_Hz < ROUNDING * max(1.0, self.start_s * sampling_Hz)] = 0.0
        return s


@dataclass(frozen=True, slots=True)
class StepProfile(_Sampled):
    """A step in the setpoint: hold the preload, and at `step_at_s` jump by the step.

    setpoint = preload_N for k < round(step_at_s f_s), preload_N + step_N after that.

    Attributes:
        preload_N: Tension held before the step, N.
        step_N: Size of the step, N; may be negative, not zero.
        step_at_s: Time of the step from the start of the trial, s; zero or above.
        duration_s: Length of the whole trial, s; after the step.
        loop: Whether the controller follows the setpoint (`closed`), or it is the effort (`open`).
        kind: Tells it from other profiles on the link.

    Raises:
        InvalidInput: a value is out of its range.
    """

    preload_N: float
    step_N: float
    step_at_s: float
    duration_s: float
    loop: Loop = "closed"
    kind: Literal["step"] = "step"

    def __post_init__(self) -> None:
        values = (self.preload_N, self.step_N, self.step_at_s, self.duration_s)
        if not all(map(math.isfinite, values)):  # ten times as fast as numpy on four floats
            raise InvalidInput(f"step profile {values} holds a value that is not finite")
        if self.step_N == 0.0:
            raise InvalidInput("the step is 0 N; without a step there is no response to score")
        if not 0.0 <= self.step_at_s < self.duration_s:
            raise InvalidInput(
                f"the step at {self.step_at_s} s must lie inside the trial of {self.duration_s} s"
            )

    @property
    def extremes_N(self) -> tuple[float, float]:
        """Least and greatest setpoint, N."""
        return _ordered(self.preload_N, self.preload_N + self.step_N)

    def step_index(self, sampling_Hz: float) -> int:
        """Index of the first sample whose setpoint is the stepped one."""
        return round(self.step_at_s * sampling_Hz)

    def setpoint(self, sampling_Hz: float) -> FloatArray:
        """The setpoint at each sample, N, shape (samples,)."""
        setpoint = np.full(self.samples(sampling_Hz), float(self.preload_N + self.step_N))
        setpoint[: self.step_index(sampling_Hz)] = self.preload_N
        return setpoint


@dataclass(frozen=True, slots=True)
class TriangleProfile(_Excitation):
    """A triangle about the preload: constant rates up and down, in cycles that may shrink.

    With the cycles passed p = s/period_s and c = floor(p),

        setpoint = preload_N + amplitude_N shrink^c (1 - |4 frac(p + 1/4) - 2|).

    It begins upward for a positive amplitude. A long period is a slow ramp through zero velocity,
    a shrink below one gives ever smaller loops inside each other.

    Attributes:
        preload_N: Mean setpoint, N.
        amplitude_N: Of the first cycle, N; may be negative, not zero.
        period_s: Length of a cycle, s; above zero.
        duration_s: Length of the whole trial, s; after the start.
        start_s: Time for which the preload is held first, s; zero or above.
        shrink: What a cycle's amplitude is of that before it; above zero, at most one.
        loop: As in `StepProfile`.
        kind: As in `StepProfile`.

    Raises:
        InvalidInput: a value is out of its range.
    """

    preload_N: float
    amplitude_N: float
    period_s: float
    duration_s: float
    start_s: float = 0.0
    shrink: float = 1.0
    loop: Loop = "closed"
    kind: Literal["triangle"] = "triangle"

    def __post_init__(self) -> None:
        _check(self, ("amplitude_N",), ("period_s",))
        if not 0.0 < self.shrink <= 1.0:
            raise InvalidInput(
                f"triangle profile: shrink is {self.shrink}; it must be above zero, at most 1"
            )

    @property
    def extremes_N(self) -> tuple[float, float]:
        """Least and greatest setpoint, N; those of the first cycle."""
        size = abs(self.amplitude_N)
        return self.preload_N - size, self.preload_N + size

    def setpoint(self, sampling_Hz: float) -> FloatArray:
        """The setpoint at each sample, N, shape (samples,)."""
        s = self._since_start(sampling_Hz)
        p = np.maximum(s, 0.0) / self.period_s
        triangle = 1.0 - np.abs(4.0 * np.mod(p + 0.25, 1.0) - 2.0)
        amplitude = self.amplitude_N * self.shrink ** np.floor(p)
        return np.where(s < 0.0, self.preload_N, self.preload_N + amplitude * triangle)


@dataclass(frozen=True, slots=True)
class MultisineProfile(_Excitation):
    """A sum of sines on the lines of a period, with the low peak of Schroeder's phases.

    Line l lies at f_l = l/period_s. The excited lines are those from `first_line` to `last_line`
    that `lines` names: `all`; `odd`, which leaves the even lines to even distortion; `odd_sparse`,
    which also leaves one of every four odd lines out, to show odd distortion: of the m-th complete
    group of four, m from 0, the one at place floor(4 frac((m + 1) (sqrt(5) - 1)/2)), from 0.

    With the weights w_l = max(f_l/corner_Hz, 1)^slope (1 where the slope is 0), their share of
    power p_l = w_l^2/sum w^2, and the excited lines in rising order,

        phi_l    = -2 pi sum over the lines i up to l of the sum of p over the lines before i
        setpoint = preload_N + rms_N sum_l sqrt(2 p_l) sin(2 pi f_l s + phi_l)

    (Schroeder, IEEE Trans. Information Theory 16 (1970) 85). A trial whose period is a whole
    number of samples, and whose duration is the start and whole periods, has no leakage.

    Attributes:
        preload_N: Mean setpoint, N.
        rms_N: Root mean square of the signal about it, N; above zero.
        period_s: Length of a period, s; above zero.
        first_line: Lowest line, from 1.
        last_line: Highest line; below half the sampling rate.
        duration_s: Length of the whole trial, s; after the start.
        start_s: Time for which the preload is held first, s; zero or above.
        lines: Which of the lines are excited.
        slope: How the amplitudes go with frequency above the corner; 1 to 1.5 suits a reel, whose
            response falls off with f^2.
        corner_Hz: Where the slope begins; above zero.
        loop: As in `StepProfile`.
        kind: As in `StepProfile`.

    Raises:
        InvalidInput: a value is out of its range.
    """

    preload_N: float
    rms_N: float
    period_s: float
    first_line: int
    last_line: int
    duration_s: float
    start_s: float = 0.0
    lines: Lines = "all"
    slope: float = 0.0
    corner_Hz: float = 1.0
    loop: Loop = "closed"
    kind: Literal["multisine"] = "multisine"

    def __post_init__(self) -> None:
        _check(self, ("rms_N",), ("period_s", "rms_N", "corner_Hz"))
        if not 1 <= self.first_line <= self.last_line <= MOST_LINES:
            raise InvalidInput(
                f"multisine profile: lines {self.first_line} to {self.last_line}; they must rise "
                f"from 1 or above to at most {MOST_LINES}"
            )
        if not self.excited.size:
            raise InvalidInput(
                f"multisine profile: no {self.lines} line lies from {self.first_line} to "
                f"{self.last_line}; use a wider band"
            )
        if not abs(self.slope) <= STEEPEST:
            raise InvalidInput(
                f"multisine profile: slope is {self.slope}; it must lie within {STEEPEST:g}"
            )

    @property
    def excited(self) -> NDArray[np.int64]:
        """The lines that carry the signal, rising."""
        return _excited(self.first_line, self.last_line, self.lines)

    @property
    def extremes_N(self) -> tuple[float, float]:
        """Bounds of the setpoint, N: held between any samples, and at most 2 % too wide."""
        size = self.rms_N * _multisine_peak(
            *(self.first_line, self.last_line, self.lines, self.slope),
            self.corner_Hz * self.period_s,
        )
        return self.preload_N - size, self.preload_N + size

    def setpoint(self, sampling_Hz: float) -> FloatArray:
        """The setpoint at each sample, N, shape (samples,).

        Raises:
            InvalidInput: the highest line is at half the sampling rate or above.
        """
        last_Hz = self.last_line / self.period_s
        if not last_Hz < sampling_Hz / 2.0:
            raise InvalidInput(
                f"multisine profile: its highest line is at {last_Hz:g} Hz; it must lie below "
                f"half the sampling rate, {sampling_Hz / 2.0:g} Hz"
            )
        s = self._since_start(sampling_Hz)
        amplitude, phase = _amplitudes_and_phases(
            self.excited, self.slope, self.corner_Hz * self.period_s
        )
        total = np.zeros(s.size)
        for l, a, phi in zip(self.excited, amplitude, phase, strict=True):
            total += a * np.sin(2.0 * np.pi * l / self.period_s * s + phi)
        return np.where(s < 0.0, self.preload_N, self.preload_N + self.rms_N * total)


@dataclass(frozen=True, slots=True)
class ChirpProfile(_Excitation):
    """A sine whose frequency goes evenly from one to the other in the time after the start.

    With S = duration_s - start_s,

        setpoint = preload_N + amplitude_N sin(2 pi (first_Hz s + (last_Hz - first_Hz) s^2/(2 S))).

    Attributes:
        preload_N: Mean setpoint, N.
        amplitude_N: Amplitude, N; may be negative, not zero.
        first_Hz: Frequency at the start; zero or above.
        last_Hz: Frequency at the end; zero or above, below half the sampling rate.
        duration_s: Length of the whole trial, s; after the start.
        start_s: Time for which the preload is held first, s; zero or above.
        loop: As in `StepProfile`.
        kind: As in `StepProfile`.

    Raises:
        InvalidInput: a value is out of its range.
    """

    preload_N: float
    amplitude_N: float
    first_Hz: float
    last_Hz: float
    duration_s: float
    start_s: float = 0.0
    loop: Loop = "closed"
    kind: Literal["chirp"] = "chirp"

    def __post_init__(self) -> None:
        _check(self, ("amplitude_N",), ())
        if not (min(self.first_Hz, self.last_Hz) >= 0.0 < max(self.first_Hz, self.last_Hz)):
            raise InvalidInput(
                f"chirp profile: {self.first_Hz:g} to {self.last_Hz:g} Hz; give frequencies of "
                "zero or above, not both zero"
            )

    @property
    def extremes_N(self) -> tuple[float, float]:
        """Least and greatest setpoint, N."""
        size = abs(self.amplitude_N)
        return self.preload_N - size, self.preload_N + size

    def setpoint(self, sampling_Hz: float) -> FloatArray:
        """The setpoint at each sample, N, shape (samples,).

        Raises:
            InvalidInput: a frequency is half the sampling rate or above.
        """
        highest_Hz = max(self.first_Hz, self.last_Hz)
        if not highest_Hz < sampling_Hz / 2.0:
            raise InvalidInput(
                f"chirp profile: it reaches {highest_Hz:g} Hz; it must stay below half the "
                f"sampling rate, {sampling_Hz / 2.0:g} Hz"
            )
        s = self._since_start(sampling_Hz)
        rate = (self.last_Hz - self.first_Hz) / (self.duration_s - self.start_s)  # Hz/s
        sine = np.sin(2.0 * np.pi * (self.first_Hz * s + 0.5 * rate * s**2))
        return np.where(s < 0.0, self.preload_N, self.preload_N + self.amplitude_N * sine)


@dataclass(frozen=True, slots=True)
class StaircaseProfile(_Excitation):
    """Stairs up and down again, each held: steps of one size at several tensions.

    With the stairs passed j = floor(s/hold_s), and c = (j + 1) mod (2 stairs),

        setpoint = preload_N + step_N min(c, 2 stairs - c).

    One stair is a step and its return, repeated; a long hold shows what creeps and drifts.

    Attributes:
        preload_N: The lowest level, N; the highest where the step is negative.
        step_N: Height of a stair, N; may be negative, not zero.
        stairs: Stairs from the preload to the farthest level, from 1.
        hold_s: Time on each level, s; above zero.
        duration_s: Length of the whole trial, s; after the start.
        start_s: Time for which the preload is held first, s; zero or above.
        loop: As in `StepProfile`.
        kind: As in `StepProfile`.

    Raises:
        InvalidInput: a value is out of its range.
    """

    preload_N: float
    step_N: float
    stairs: int
    hold_s: float
    duration_s: float
    start_s: float = 0.0
    loop: Loop = "closed"
    kind: Literal["staircase"] = "staircase"

    def __post_init__(self) -> None:
        _check(self, ("step_N",), ("hold_s",))
        if self.stairs < 1:
            raise InvalidInput(f"staircase profile: {self.stairs} stairs; give 1 or more")

    @property
    def extremes_N(self) -> tuple[float, float]:
        """Least and greatest setpoint of a whole staircase, N."""
        return _ordered(self.preload_N, self.preload_N + self.stairs * self.step_N)

    def setpoint(self, sampling_Hz: float) -> FloatArray:
        """The setpoint at each sample, N, shape (samples,)."""
        s = self._since_start(sampling_Hz)
        c = np.mod(np.floor(s / self.hold_s + ROUNDING) + 1.0, 2.0 * self.stairs)
        level = np.minimum(c, 2.0 * self.stairs - c)
        return np.where(s < 0.0, self.preload_N, self.preload_N + self.step_N * level)


class _ByKind:
    """Lets pydantic tell the profiles apart by `kind`; it is slow to import, so not done here."""

    def __get_pydantic_core_schema__(self, source: Any, handler: Any) -> Any:
        from pydantic import Field  # noqa: PLC0415  slow to import, not needed by every command

        return handler(Annotated[source, Field(discriminator="kind")])


AnyProfile: TypeAlias = (
    StepProfile | TriangleProfile | MultisineProfile | ChirpProfile | StaircaseProfile
)
Profile: TypeAlias = Annotated[AnyProfile, _ByKind()]
"""Whatever a trial may ask for."""

PROFILES: tuple[type[AnyProfile], ...] = get_args(AnyProfile)


def _ordered(one: float, other: float) -> tuple[float, float]:
    return (one, other) if one <= other else (other, one)


def _check(profile: AnyProfile, not_zero: tuple[str, ...], above_zero: tuple[str, ...]) -> None:
    """Refuses values that are not finite, zero or below where they must not be, or out of time.

    Raises:
        InvalidInput: one is.
    """
    for field in fields(profile):
        value = getattr(profile, field.name)
        if isinstance(value, str):
            continue
        if not math.isfinite(value):
            raise InvalidInput(f"{profile.kind} profile: {field.name} is {value}; give a number")
        if (field.name in above_zero and value <= 0.0) or (field.name in not_zero and not value):
            wanted = "above zero" if field.name in above_zero else "other than zero"
            raise InvalidInput(
                f"{profile.kind} profile: {field.name} is {value}; it must be {wanted}"
            )
    start = getattr(profile, "start_s", 0.0)
    if not 0.0 <= start < profile.duration_s:
        raise InvalidInput(
            f"{profile.kind} profile: the start at {start} s must lie inside the trial of "
            f"{profile.duration_s} s"
        )


@lru_cache(maxsize=64)
def _excited(first: int, last: int, which: Lines) -> NDArray[np.int64]:
    """The excited lines, rising and read-only."""
    lines = np.arange(first, last + 1)
    if which != "all":
        lines = lines[lines % 2 == 1]
    if which == "odd_sparse":
        group = np.arange(lines.size // ODD_GROUP)
        place = np.floor(ODD_GROUP * np.mod((group + 1) * GOLDEN, 1.0)).astype(np.int64)
        lines = np.delete(lines, group * ODD_GROUP + place)
    lines.flags.writeable = False
    return lines


def _amplitudes_and_phases(
    lines: NDArray[np.int64], slope: float, corner_line: float
) -> tuple[FloatArray, FloatArray]:
    """sqrt(2 p_l) and phi_l of each line, for a signal of rms one."""
    weight = np.maximum(lines / corner_line, 1.0) ** slope
    power = weight**2 / (weight**2).sum()
    before = np.concatenate([[0.0], np.cumsum(power)[:-1]])
    return np.sqrt(2.0 * power), -2.0 * np.pi * np.cumsum(before)


@lru_cache(maxsize=64)
def _multisine_peak(
    first: int, last: int, which: Lines, slope: float, corner_line: float
) -> float:
    """A bound on the size of the multisine of rms one.

    On a grid of m points in a period of the highest line, the largest value misses the peak by no
    more than a factor of cos(pi/m) (Ehlich & Zeller, Math. Zeitschrift 86 (1964) 41).
    """
    lines = _excited(first, last, which)
    amplitude, phase = _amplitudes_and_phases(lines, slope, corner_line)
    points = PEAK_SAMPLES * last
    spectrum = np.zeros(points // 2 + 1, np.complex128)
    spectrum[lines] = -0.5j * points * amplitude * np.exp(1j * phase)  # sine, not cosine
    peak = float(np.abs(np.fft.irfft(spectrum, points)).max())
    return peak / math.cos(math.pi / PEAK_SAMPLES)
