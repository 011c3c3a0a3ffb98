"""What does a trial cost over the link, beside what it costs the wire to carry the same bytes?

A rig in another process answers at once with a record of 5 x 2000 float64. One trial is all that a
tuner waits for: the submit, the record's frame, its decoding, and the commit of it to the journal
together with the next request. Beside it, in the same run and turn by turn, a plain Zenoh get of
the same number of bytes from the same process, and a plain write of them to the same disk. The
medians are compared; the limit is three times the plain get.
"""

import argparse
import json
import os
import secrets
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import numpy as np

from estune import bus, frame
from estune.bus.session import COMMANDS_MAX_BYTES, open_session, with_port
from estune.core.gains import Gains
from estune.core.pidf import ControllerSettings
from estune.journal import Journal
from estune.session import Phase
from estune.trial import Outcome, RigDescription, RigLimits, StepProfile, TrialRecord, TrialRequest

SAMPLES, SAMPLING_HZ = 2000, 632.0
LIMIT = 3.0  # times the plain get
GAINS = Gains(1.0, 50.0, 0.01, 0.02)
STEP = StepProfile(15.0, 5.0, 0.1, SAMPLES / SAMPLING_HZ)
PLAIN_KEY = "plain/record"
PARTS = {
    "trial": "all a tuner waits for:",
    "link": "  submit, the rig's answer, the record decoded",
    "commit": "  the record in the journal, with the next request",
    "plain get": "as many bytes by a plain Zenoh get",
    "plain write": "as many bytes appended to a file, with fdatasync",
    "codec": "encoding and decoding, done once more in this process",
}


def canned_record() -> TrialRecord:
    """A record of noise, which no layer can compress."""
    time_s, setpoint_N, tension_N, current_A, angle_rad = np.random.default_rng(0).normal(
        size=(5, SAMPLES)
    )
    return TrialRecord(
        trial_id="",
        rig="canned",
        sampling_Hz=SAMPLING_HZ,
        cable_length_m=0.8,
        preload_N=STEP.preload_N,
        gains=GAINS,
        outcome=Outcome.DONE,
        reason="",
        started_at="2009-05-04T12:00:00+02:00",
        software="benchmark 1",
        time_s=time_s,
        setpoint_N=setpoint_N,
        tension_N=tension_N,
        current_A=current_A,
        angle_rad=angle_rad,
        flags=np.zeros(SAMPLES, np.uint8),
    )


class CannedRig:
    """Answers every trial at once with the same columns."""

    def __init__(self) -> None:
        record = canned_record()
        names = {field.name for field in fields(record)} - {"trial_id", "gains"}
        self._facts: dict[str, Any] = {name: getattr(record, name) for name in names}

    def describe(self) -> RigDescription:
        """What a rig of this length of trial would be."""
        controller = ControllerSettings(SAMPLING_HZ, 0.001, -120.0, 120.0)
        limits = RigLimits(0.0, 50.0, 10.0)
        return RigDescription("canned", GAINS, controller, 20.0, limits, STEP, 0.1)

    def run(self, request: TrialRequest) -> TrialRecord:
        """The canned record under the id asked for."""
        return TrialRecord(**self._facts, trial_id=request.trial_id, gains=request.gains)

    def apply(self, gains: Gains) -> None:
        """Nothing is live here."""

    def abort(self) -> RigDescription:
        """Nothing is ever under way."""
        return self.describe()

    def close(self) -> None:
        """Nothing is held."""


def serve() -> None:
    """Serves the canned rig, and beside it the plain bytes, until standard input is closed."""
    payload = secrets.token_bytes(len(frame.encode(canned_record())))
    endpoint = with_port("tcp/127.0.0.1:0")
    with (
        bus.serve(CannedRig()) as server,
        open_session("peer", listen=(endpoint,), message_max_bytes=COMMANDS_MAX_BYTES) as plain,
    ):
        plain.declare_queryable(PLAIN_KEY, lambda query: query.reply(PLAIN_KEY, payload))
        print(server.endpoint, endpoint, flush=True)
        sys.stdin.read()


@contextmanager
def served() -> Iterator[tuple[str, str]]:
    """The endpoints of the rig and of the plain bytes, served by a process of their own."""
    command = [sys.executable, "-m", "experiments.benchmark_link", "--serve"]
    with subprocess.Popen(  # noqa: S603  starts this file
        command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as process:
        try:
            line = process.stdout.readline() if process.stdout else ""
            if not line:
                sys.exit("the serving process has failed")
            rig, plain = line.split()
            yield rig, plain
        finally:
            process.kill()


class Stopwatch:
    """Times of the parts of a trial, s, one per turn."""

    def __init__(self) -> None:
        self.times: dict[str, list[float]] = {}

    @contextmanager
    def part(self, name: str) -> Iterator[None]:
        """Times what is done inside the block."""
        began = time.perf_counter()
        yield
        self.times.setdefault(name, []).append(time.perf_counter() - began)

    def median_ms(self, name: str) -> float:
        """The median of a part, ms."""
        return 1e3 * statistics.median(self.times[name])


def measure(turns: int, warm_up: int, folder: Path) -> tuple[Stopwatch, int]:
    """Runs trials, plain gets and plain writes in turn.

    Returns:
        The times, and the bytes of a record's frame.
    """
    watch = Stopwatch()
    with ExitStack() as stack:
        endpoint, plain_endpoint = stack.enter_context(served())
        rig = stack.enter_context(bus.connect(endpoint))
        plain = stack.enter_context(
            open_session(
                "client", connect=(plain_endpoint,), message_max_bytes=2 * frame.MAX_BYTES
            )
        )
        journal = stack.enter_context(Journal.create(folder / "run", {}))
        file = stack.enter_context((folder / "plain").open("wb", buffering=0))
        request = TrialRequest("benchmark", 0, GAINS, STEP)
        journal.commit(None, (request, Phase.SEARCH))
        for turn in range(warm_up + turns):
            if turn == warm_up:
                watch.times.clear()
            following = replace(request, number=turn + 1)
            with watch.part("trial"):
                with watch.part("link"):
                    record = rig.run(request)
                with watch.part("commit"):
                    journal.commit((request, record, 1.0), (following, Phase.SEARCH))
            request = following
            with watch.part("plain get"):
                # The first reply is the answer; the end of the query may come a millisecond later.
                reply = next(iter(plain.get(PLAIN_KEY, timeout=5.0)))
                data = reply.result.payload.to_bytes()
            with watch.part("plain write"):
                file.write(data)
                os.fdatasync(file.fileno())
            with watch.part("codec"):
                frame.decode(frame.encode(replace(record)))
    return watch, len(data)


def main() -> None:
    """Measures, prints the table or, with --json, the figures."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0] if __doc__ else "")
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    parser.add_argument("--quick", action="store_true", help="a few trials only")
    parser.add_argument("--folder", type=Path, help="on which disk to keep the journal")
    parser.add_argument("--serve", action="store_true", help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.serve:
        serve()
        return
    turns = 100 if arguments.quick else 2000
    with tempfile.TemporaryDirectory(dir=arguments.folder) as folder:
        watch, size = measure(turns, turns // 10, Path(folder))
    ratio = watch.median_ms("trial") / watch.median_ms("plain get")
    figures = {f"{name.replace(' ', '_')}_ms": watch.median_ms(name) for name in watch.times}
    figures |= {"record_bytes": size, "turns": turns, "overhead_ratio": ratio}
    target = {"value": ratio, "limit": LIMIT, "met": ratio < LIMIT}
    if arguments.json:
        print(json.dumps({"figures": figures, "targets": {"overhead_ratio": target}}))
        return
    print(f"{turns} trials over loopback, records of {size} bytes; medians\n")
    for name, what in PARTS.items():
        print(f"  {name:12} {watch.median_ms(name):7.3f} ms  {what}")
    verdict = "met" if target["met"] else "missed"
    print(f"\na trial takes {ratio:.2f} times a plain get; limit {LIMIT:g}: {verdict}")


if __name__ == "__main__":
    main()
