"""Benchmark of a trial over the link, compared with a plain transfer of the same bytes.

A rig in another process answers at once with a record of 5 x 2000 float64. A tuner waits for the
submit, the record's frame, its decoding, and its commit to the journal together with the next
request. Alternating with it in the same run, a plain Zenoh get fetches as many bytes from the same
process, and a plain write appends them to a file on the same disk. The medians are compared; the
limit of the link, to the decoded record, is three times the plain get. The commit is told apart:
it compresses the record, which takes the longest with noise, as no record is. A trial from a rig
with its ledger on disk shows the cost of surviving a power cut.

Printed are medians, ms: `trial` is what a tuner waits for, of which `link` is submit, reply and
decoding, `commit` that of the record and the next request to the journal; `noted link` has the
rig's ledger on disk; `codec` and `compression` of the record are repeated in this process.

Then emergency stops are called repeatedly, while another process queries records at full rate. The
figure is the 99th centile of the time until the rig has replied.
"""

import argparse
import logging
import os
import secrets
import statistics
import sys
import tempfile
import threading
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from estune.core.gains import Gains
from estune.remote import messages, zenoh
from estune.remote.messages import Inquire, Keys
from estune.remote.zenoh.endpoints import with_port
from estune.remote.zenoh.zenoh_session import COMMANDS_MAX_BYTES, open_session
from estune.run.compressed_frame import compress
from estune.run.journal import CompletedTrial, Journal
from estune.run.session import Phase
from estune.support.child_process import child_process, next_line
from estune.trial import (
    Outcome,
    TrialRecord,
    TrialRequest,
    record_frame,
)
from estune.trial.profiles import StepProfile
from experiments.inert_rig import DESCRIBED, RECORD, InertRig
from experiments.results import Target, command_line, print_results

SAMPLES, SAMPLING_HZ = 2000, 632.0
LIMIT = 3.0  # times the plain get
STOP_LIMIT_MS = 5.0
PULLERS = 3
GAINS = Gains(1.0, 50.0, 0.01, 0.02)
STEP = StepProfile(15.0, 5.0, 0.1, SAMPLES / SAMPLING_HZ)
PLAIN_KEY = "plain/record"
THIS = "experiments.benchmark_link"


def record() -> TrialRecord:
    """A record of noise, which no layer can compress."""
    columns = np.random.default_rng(0).normal(size=(5, SAMPLES))
    names = ("time_s", "setpoint_N", "tension_N", "current_A", "angle_rad")
    samples: dict[str, Any] = dict(zip(names, columns, strict=True))
    return replace(RECORD, **samples, flags=np.zeros(SAMPLES, np.uint8), outcome=Outcome.DONE)


def rig(name: str) -> InertRig:
    """A rig that answers with that record."""
    return InertRig(replace(DESCRIBED, name=name, step=STEP, gains=GAINS), record())


def serve(folder: Path | None) -> None:
    """Serves two rigs and the plain bytes, until standard input is closed."""
    logging.disable()  # each stop would be a line
    payload = secrets.token_bytes(len(record_frame.encode(record())))
    endpoint = with_port("tcp/127.0.0.1:0")
    with (
        tempfile.TemporaryDirectory(dir=folder) as ledgers,
        zenoh.serve(rig("memory")) as server,
        zenoh.serve(rig("disk"), ledger=Path(ledgers) / "ledger") as noted,
        open_session("peer", listen=(endpoint,), message_max_bytes=COMMANDS_MAX_BYTES) as plain,
    ):
        plain.declare_queryable(PLAIN_KEY, lambda query: query.reply(PLAIN_KEY, payload))
        print(server.endpoint, noted.endpoint, endpoint, flush=True)
        sys.stdin.read()


def pull(endpoint: str) -> None:
    """Queries one record after another, by several threads, until standard input is closed."""
    with zenoh.connect(endpoint) as remote:
        request = TrialRequest("pulled", 0, GAINS, STEP)
        remote.run(request)
        keys, payload = Keys("memory"), messages.encode(Inquire(messages.digest(request)))
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


class Stopwatch:
    """Durations of the parts of a trial, s, one per turn."""

    def __init__(self) -> None:
        self.times: dict[str, list[float]] = {}

    @contextmanager
    def part(self, name: str) -> Iterator[None]:
        """Measures the duration of the block."""
        began = time.perf_counter()
        yield
        self.times.setdefault(name, []).append(time.perf_counter() - began)

    def median_ms(self, name: str) -> float:
        """Median duration of a part, ms."""
        return 1e3 * statistics.median(self.times[name])

    def slow_ms(self, name: str) -> float:
        """99th centile of the duration of a part, ms."""
        return 1e3 * statistics.quantiles(self.times[name], n=100)[-1]


def measure(turns: int, warm_up: int, folder: Path) -> tuple[Stopwatch, int]:
    """Durations of interleaved trials, plain gets and writes, then of stops; size of a frame."""
    watch = Stopwatch()
    with ExitStack() as stack:
        serving = child_process(THIS, "--serve", "--folder", str(folder))
        endpoint, noted_endpoint, plain_endpoint = next_line(stack.enter_context(serving)).split()
        remote = stack.enter_context(zenoh.connect(endpoint))
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
                    result = remote.run(request)
                with watch.part("commit"):
                    done = CompletedTrial(request, result, 1.0, 1.0)
                    journal.commit(done, (following, Phase.SEARCH))
            with watch.part("noted link"):
                noted.run(request)
            request = following
            with watch.part("plain get"):
                # The first reply is the record; the query may end a millisecond later.
                reply = next(iter(plain.get(PLAIN_KEY, timeout=5.0)))
                data = reply.result.payload.to_bytes()
            with watch.part("plain write"):
                file.write(data)
                os.fdatasync(file.fileno())
            with watch.part("codec"):
                frame = record_frame.encode(replace(result))
                record_frame.decode(frame)
            with watch.part("compression"):
                compress(frame)
        remote.release()
        stops(remote, watch, "idle stop", turns)
        next_line(stack.enter_context(child_process(THIS, "--pull", endpoint)))
        stops(remote, watch, "stop", turns)
    return watch, len(data)


def stops(remote: zenoh.RemoteRig, watch: Stopwatch, part: str, turns: int) -> None:
    """Stops the rig repeatedly, and clears it each time."""
    remote.estop("the first one opens a connection")
    for _ in range(turns):
        with watch.part(part):
            remote.estop("benchmark")
        remote.clear()


def main() -> int:
    """Measures and prints; returns 1 where a target is missed."""
    parser = command_line(__doc__, quick="a few trials only")
    parser.add_argument("--folder", type=Path, help="folder for journal and ledger")
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
    ratio = watch.median_ms("link") / watch.median_ms("plain get")
    figures = {f"{name.replace(' ', '_')}_ms": watch.median_ms(name) for name in watch.times}
    figures |= {"record_bytes": size, "turns": turns, "overhead_ratio": ratio}
    stop_ms = watch.slow_ms("stop")
    figures |= {"idle_stop_p99_ms": watch.slow_ms("idle stop"), "stop_p99_ms": stop_ms}
    targets = {
        "overhead_ratio": Target(ratio, LIMIT, ratio < LIMIT),
        "stop_p99_ms": Target(stop_ms, STOP_LIMIT_MS, stop_ms < STOP_LIMIT_MS),
    }
    return print_results(figures, targets, as_json=arguments.json, tables=True)


if __name__ == "__main__":
    raise SystemExit(main())
