"""What does tuning the reels change for a platform moved by a tension distribution over the link?

Command: `python -m experiments.platform_tracking`.
Target: half the position error, at 90 % of the rate asked for.

Four simulated reels hold a platform in a vertical plane, in a process of its own, each served over
Zenoh. This process is their source: it finds the pose from the drums' angles, computes the wrench
that keeps the platform on a circle, distributes it over the cables, and sends the tensions. The
circle is run with the gains that the reels had, then all reels are tuned over the link by step
trials, and it is run again.
"""

import math
import sys
import tempfile
import time
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from typing import Any, NamedTuple

import numpy as np

import estune
from estune.core.quantities import FloatArray
from estune.reel.hybrid import SwitchingRules
from estune.remote.zenoh import RemoteRig, SetpointStream, connect
from estune.trial import Setpoint
from experiments.paper.cable_platform import PoseController
from experiments.results import Target, at_least, at_most, command_line, print_results
from plants.bench.cable_platform.examples import platform, served

RADIUS_M, TURN_HZ = 0.1, 0.35
NATURAL_RAD_S, DAMPING_RATIO = 10.0, 1.0
"""Of the pose loop. At 18 rad/s the platform oscillates with the reels' gains before tuning."""

RULES = SwitchingRules(tension_min_N=5.0, margin_N=1.0)
TENSION_MAX_N = 40.0
FADE_IN_S = 1.0
REST_S = 3.0
"""Time in which the platform comes to rest with its reels at their hold tensions."""


class Tracking(NamedTuple):
    """One run along the circle; each column has a row for each period."""

    time_s: FloatArray
    sent_s: FloatArray
    wanted: FloatArray
    pose: FloatArray
    tension_error_N: FloatArray
    round_trip_s: FloatArray

    def after_start(self) -> "Tracking":
        """Without the time in which the circle fades in and the platform settles."""
        rows = self.time_s > 2.0 * FADE_IN_S
        return Tracking(*(column[rows] for column in self))


def circle(time_s: float, start: FloatArray) -> FloatArray:
    """Pose, its derivative and its second derivative, shape (3, 3).

    A circle through home, faded in from the pose at the start.
    """
    w, share = 2.0 * math.pi * TURN_HZ, min(1.0, time_s / FADE_IN_S)
    turn = np.array([math.cos(w * time_s), math.sin(w * time_s), 0.0])
    ahead = np.array([-turn[1], turn[0], 0.0])
    centre = np.array([1.0, 0.0, 0.0])
    faded = np.array([(1.0 - share) ** 2 * start, np.zeros(3), np.zeros(3)])
    return faded + RADIUS_M * share**2 * np.array([turn - centre, w * ahead, -(w**2) * turn])


def track(rigs: Sequence[RemoteRig], rate_Hz: float, duration_s: float) -> Tracking:
    """Moves the platform from rest along the circle, in real time."""
    mechanism, _ = platform()
    controller = PoseController(
        mechanism,
        natural_rad_s=NATURAL_RAD_S,
        damping_ratio=DAMPING_RATIO,
        rules=RULES,
        tension_max_N=TENSION_MAX_N,
    )
    stream = SetpointStream(rigs, rate_Hz)
    setpoints: Sequence[Setpoint] = [Setpoint(reel.tension_N) for reel in mechanism.reels]
    rows: list[tuple[Any, ...]] = []
    start = np.zeros(3)
    began_s = time_s = 0.0
    while time_s < duration_s:
        sent_s, feedback, trips = stream.exchange(setpoints)
        if not rows:
            began_s, start = feedback[0].time_s, controller.estimate(feedback).copy()
        time_s = feedback[0].time_s - began_s  # the reels' clock, by which the platform moves
        error = [f.tension_N - s.tension_N for f, s in zip(feedback, setpoints, strict=True)]
        wanted = circle(time_s, start)
        setpoints = controller.update(feedback, *wanted)
        rows.append((time_s, sent_s, wanted[0], controller.pose, error, trips))
    return Tracking(*(np.array(column) for column in zip(*rows, strict=True)))


def tracking_row(tracking: Tracking) -> dict[str, float]:
    """Errors of a run."""
    settled = tracking.after_start()
    error = settled.pose - settled.wanted
    return {
        "position rms (mm)": 1e3 * float(np.sqrt((error[:, :2] ** 2).sum(axis=1).mean())),
        "position max (mm)": 1e3 * float(np.sqrt((error[:, :2] ** 2).sum(axis=1)).max()),
        "turn rms (deg)": math.degrees(float(np.sqrt((error[:, 2] ** 2).mean()))),
        "tension rms (N)": float(np.sqrt((settled.tension_error_N**2).mean())),
    }


def link_row(tracking: Tracking) -> dict[str, float]:
    """Rate reached, and time from a setpoint to the reply of its reel."""
    trips_ms = 1e3 * tracking.round_trip_s[np.isfinite(tracking.round_trip_s)]
    return {
        "rate (Hz)": float((len(tracking.sent_s) - 1) / np.ptp(tracking.sent_s)),
        "round trip median (ms)": float(np.median(trips_ms)),
        "99 % (ms)": float(np.percentile(trips_ms, 99.0)),
        "longest period (ms)": 1e3 * float(np.diff(tracking.sent_s).max()),
        "late replies (%)": 100.0 * float(np.isnan(tracking.round_trip_s).mean()),
    }


def tuned(endpoints: Mapping[str, str], trials: int) -> list[estune.Gains]:
    """Tunes each reel over the link; its gains."""
    with tempfile.TemporaryDirectory() as folder:
        return [
            estune.tune(endpoint, trials=trials, folder=folder, watch=None).gains
            for endpoint in endpoints.values()
        ]


def targets(figures: Mapping[str, Any], rate_Hz: float) -> dict[str, Target]:
    """The tuned platform follows better, and the link keeps the source's rate."""
    rows = figures["tracking"]
    key = "position rms (mm)"
    return {
        "position error, tuned over untuned": at_most(
            rows["tuned"][key] / rows["untuned"][key], 0.5
        ),
        "rate over the one requested": at_least(
            min(row["rate (Hz)"] for row in figures["link"].values()) / rate_Hz, 0.9
        ),
    }


def main() -> int:
    """Prints tracking errors and the link's times."""
    parser = command_line(__doc__, quick="4 s along the circle, 6 trials a reel")
    parser.add_argument("--rate", type=float, default=100.0, help="setpoints per second")
    options = parser.parse_args()
    duration_s, trials = (4.0, 6) if options.quick else (12.0, 60)
    runs: dict[str, Tracking] = {}
    with ExitStack() as stack:
        endpoints = stack.enter_context(served("platform"))
        rigs = [stack.enter_context(connect(endpoint)) for endpoint in endpoints.values()]
        before = [rig.describe().gains for rig in rigs]
        runs["untuned"] = track(rigs, options.rate, duration_s)
        for rig in rigs:
            rig.release()
        after = tuned(endpoints, trials)
        for rig, gains in zip(rigs, after, strict=True):
            rig.apply(gains)
        time.sleep(REST_S)
        runs["tuned"] = track(rigs, options.rate, duration_s)
    all_gains = {
        f"{name}, {reel}": dict(zip(("P", "I", "D", "filter_s"), own.as_tuple(), strict=True))
        for name, each in (("untuned", before), ("tuned", after))
        for reel, own in zip(endpoints, each, strict=True)
    }
    figures = {
        "gains": all_gains,
        "tracking": {name: tracking_row(run) for name, run in runs.items()},
        "link": {name: link_row(run) for name, run in runs.items()},
    }
    reached = targets(figures, options.rate)
    return print_results(figures, reached, as_json=options.json, tables=True)


if __name__ == "__main__":
    sys.exit(main())
