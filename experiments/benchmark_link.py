"""What does a trial cost over the link, beside what it costs the wire to carry the same bytes?

A rig in another process answers at once with a record of 5 x 2000 float64. One trial is all that a
tuner waits for: the submit, the record's frame, its decoding, and the commit of it to the journal
together with the next request. Beside it, in the same run and turn by turn, a plain Zenoh get of
the same number of bytes from the same process, and a plain write of them to the same disk. The
medians are compared; the limit is three times the plain get. The same trial from a rig that keeps
its ledger on disk shows what it costs to be able to lose power.

Then an emergency stop, again and again, while another process pulls records as fast as it can:
what counts is the time until the rig has answered, and of that the slowest hundredth.
"""

import argparse
import logging
import os
import secrets
import statistics
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import numpy as np

from estune.core.gains import Gains
from estune.core.pidf import ControllerSettings
from estune.remote import messages, zenoh
from estune.remote.messages import Inquire, Keys
from estune.remote.zenoh.zenoh_session import COMMANDS_MAX_BYTES, open_session, with_port
from estune.run.journal import Journal
from estune.run.session import Phase
from estune.trial import (
    Outcome,
    RigDescription,
    RigLimits,
    TrialRecord,
    TrialRequest,
    record_frame,
)
from estune.trial.profiles import StepProfile
from experiments.judged import Target, command_line, tell

SAMPLES, SAMPLING_HZ = 2000, 632.0
LIMIT = 3.0  # times the plain get
STOP_LIMIT_MS = 5.0
PULLERS = 3
GAINS = Gains(1.0, 50.0, 0.01, 0.02)
STEP = StepProfile(15.0, 5.0, 0.1, SAMPLES / SAMPLING_HZ)
PLAIN_KEY = "plain/record"
PARTS = {
    "trial": "all a tuner waits for:",
    "link": "  submit, the rig's answer, the record decoded",
    "commit": "  the record in the journal, with the next request",
    "noted link": "the link, where the rig's ledger is on disk",
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

    def __init__(self, name: str) -> None:
        self._name = name
        record = canned_record()
        names = {field.name for field in fields(record)} - {"trial_id", "gains"}
        self._facts: dict[str, Any] = {name: getattr(record, name) for name in names}

    def describe(self) -> RigDescription:
        """What a rig of this length of trial would be."""
        controller = ControllerSettings(SAMPLING_HZ, 0.001, -120.0, 120.0)
        limits = RigLimits(0.0, 50.0, 10.0)
        return RigDescription(
            *(self._name, GAINS, controller, 20.0, limits, STEP, 0.1), simulated=True
        )

    def run(self, request: TrialRequest) -> TrialRecord:
        """The canned record under the id asked for."""
        return TrialRecord(**self._facts, trial_id=request.trial_id, gains=request.gains)

    def apply(self, gains: Gains) -> None:
        """Nothing is live here."""

    def abort(self) -> RigDescription:
        """Nothing is ever under way."""
        return self.describe()

    def estop(self, reason: str) -> None:
        """Nothing ever moves here."""

    def clear(self) -> None:
        """Nothing was stopped."""

    def close(self) -> None:
        """Nothing is held."""


def serve(folder: Path | None) -> None:
    """Serves two canned rigs, and beside them the plain bytes, until standard input is closed."""
    logging.disable()  # each stop would be a line
    payload = secrets.token_bytes(len(record_frame.encode(canned_record())))
    endpoint = with_port("tcp/127.0.0.1:0")
    with (
        tempfile.TemporaryDirectory(dir=folder) as ledgers,
        zenoh.serve(CannedRig("canned")) as server,
        zenoh.serve(CannedRig("noted"), ledger=Path(ledgers) / "ledger") as noted,
        open_session("peer", listen=(endpoint,), message_max_bytes=COMMANDS_MAX_BYTES) as plain,
    ):
        plain.declare_queryable(PLAIN_KEY, lambda query: query.reply(PLAIN_KEY, payload))
        print(server.endpoint, noted.endpoint, endpoint, flush=True)
        sys.stdin.read()


def pull(endpoint: str) -> None:
    """Asks for one record after another, by several threads, until standard input is closed."""
    with zenoh.connect(endpoint) as rig:
        request = TrialRequest("pulled", 0, GAINS, STEP)
        rig.run(request)
        keys, payload = Keys("canned"), messages.encode(Inquire(messages.digest(request)))
        with open_session(
            "client", connect=(endpoint,), message_max_bytes=2 * record_frame.MAX_BYTES
        ) as session:

            def ask() -> None:
                while not ended.is_set():
                    list(session.get(keys.result(request.trial_id), payload=payload, timeout=5.0))

            ended = threading.Event()
            threads = [threading.Thread(target=ask) for _ in range(PULLERS)]
            for thread in threads:
                thread.start()
            print("pulling", flush=True)
            sys.stdin.read()
            ended.set()
            for thread in threads:
                thread.join()


@contextmanager
def started(*arguments: str) -> Iterator[list[str]]:
    """This file in a process of its own, and the first line it prints, in words."""
    command = [sys.executable, "-m", "experiments.benchmark_link", *arguments]
    with subprocess.Popen(  # noqa: S603  starts this file
        command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as process:
        try:
            line = process.stdout.readline() if process.stdout else ""
            if not line:
                sys.exit(f"the process {' '.join(arguments)} has failed")
            yield line.split()
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

    def slow_ms(self, name: str) -> float:
        """The time 99 of 100 turns of a part stay below, ms."""
        return 1e3 * statistics.quantiles(self.times[name], n=100)[-1]


def measure(turns: int, warm_up: int, folder: Path) -> tuple[Stopwatch, int]:
    """Runs trials, plain gets and plain writes in turn, then emergency stops under load.

    Returns:
        The times, and the bytes of a record's frame.
    """
    watch = Stopwatch()
    with ExitStack() as stack:
        endpoint, noted_endpoint, plain_endpoint = stack.enter_context(
            started("--serve", "--folder", str(folder))
        )
        rig = stack.enter_context(zenoh.connect(endpoint))
        noted = stack.enter_context(zenoh.connect(noted_endpoint))
        plain = stack.enter_context(
            open_session(
                "client", connect=(plain_endpoint,), message_max_bytes=2 * record_frame.MAX_BYTES
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
            with watch.part("noted link"):
                noted.run(request)
            request = following
            with watch.part("plain get"):
                # The first reply is the answer; the end of the query may come a millisecond later.
                reply = next(iter(plain.get(PLAIN_KEY, timeout=5.0)))
                data = reply.result.payload.to_bytes()
            with watch.part("plain write"):
                file.write(data)
                os.fdatasync(file.fileno())
            with watch.part("codec"):
                record_frame.decode(record_frame.encode(replace(record)))
        rig.release()
        stops(rig, watch, "idle stop", turns)
        stack.enter_context(started("--pull", endpoint))
        stops(rig, watch, "stop", turns)
    return watch, len(data)


def stops(rig: zenoh.RemoteRig, watch: Stopwatch, part: str, turns: int) -> None:
    """Stops the rig again and again, and clears it each time."""
    rig.estop("the first opens a connection")
    for _ in range(turns):
        with watch.part(part):
            rig.estop("benchmark")
        rig.clear()


def show(watch: Stopwatch) -> None:
    """Prints the tables."""
    for name, what in PARTS.items():
        print(f"  {name:12} {watch.median_ms(name):7.3f} ms  {what}")
    print("\nan emergency stop, until it is answered (median, slowest hundredth)\n")
    for name, what in (("idle stop", "nothing else going on"), ("stop", "under full record load")):
        print(f"  {watch.median_ms(name):7.3f} {watch.slow_ms(name):7.3f} ms  {what}")


def main() -> int:
    """Measures, prints, and says by its exit code whether every target was met."""
    parser = command_line(__doc__, quick="a few trials only")
    parser.add_argument("--folder", type=Path, help="on which disk to keep journal and ledger")
    parser.add_argument("--serve", action="store_true", help=argparse.SUPPRESS)
    parser.add_argument("--pull", help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.serve:
        serve(arguments.folder)
        return 0
    if arguments.pull:
        pull(arguments.pull)
        return 0
    turns = 100 if arguments.quick else 2000
    with tempfile.TemporaryDirectory(dir=arguments.folder) as folder:
        watch, size = measure(turns, turns // 10, Path(folder))
    ratio = watch.median_ms("trial") / watch.median_ms("plain get")
    figures = {f"{name.replace(' ', '_')}_ms": watch.median_ms(name) for name in watch.times}
    figures |= {"record_bytes": size, "turns": turns, "overhead_ratio": ratio}
    stop_ms = watch.slow_ms("stop")
    figures |= {"idle_stop_p99_ms": watch.slow_ms("idle stop"), "stop_p99_ms": stop_ms}
    targets = {
        "overhead_ratio": Target(ratio, LIMIT, ratio < LIMIT),
        "stop_p99_ms": Target(stop_ms, STOP_LIMIT_MS, stop_ms < STOP_LIMIT_MS),
    }
    if not arguments.json:
        print(f"{turns} trials over loopback, records of {size} bytes; medians\n")
        show(watch)
    return tell(figures, targets, as_json=arguments.json)


if __name__ == "__main__":
    raise SystemExit(main())
