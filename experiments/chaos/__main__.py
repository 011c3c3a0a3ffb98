"""`python -m experiments.chaos`: the tables, or with --json the figures."""

import contextlib
import signal
import statistics
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

from estune.remote import zenoh
from experiments import benchmark_link
from experiments.chaos import __doc__ as about
from experiments.chaos import deadman, faults, supervised, verdict
from experiments.chaos.campaign import Campaign
from experiments.chaos.stand import Stand
from experiments.judged import Target, at_most, command_line, tell

PARTS = ("estune", "plain", "daemon", "hardware", "stops")
SEARCH_TRIALS = 120
BESIDE_SEARCH = 9
NONE = (
    *("run_twice", "overlapping", "unattended", "wrong_rig", "wrong_records", "lost_records"),
    *("gains_left", "other_proposals", "unfinished", "stuck", "twins_served", "unnamed_errors"),
    "dead_man_not_restored",
)
"""What must not happen at all."""

WORDS = {
    "faults": "faults",
    "trials": "trials told to the tuner",
    "motions": "trials begun on a rig",
    "run_twice": "trials begun more than once",
    "most_often": "  the worst of them so many times",
    "overlapping": "trials begun before the one before had ended",
    "unattended": "trials begun with no client alive (lease + 100 ms)",
    "wrong_rig": "trials begun on a rig that only bears the name",
    "wrong_records": "records that are not what the rig measures",
    "lost_records": "trials the ledger and the client do not agree on",
    "gains_left": "times other gains than its own were left on the rig",
    "interrupted": "trials cut short, and told to be",
    "other_proposals": "proposals other than those of an undisturbed run",
    "unfinished": "tunings that came to another end",
    "stuck": "times nothing went on though nothing was wrong",
    "twins_served": "second processes let on to the rig's ledger",
    "unnamed_errors": "clients that ended with an error nobody named",
}


class Extent(NamedTuple):
    """How much is done.

    Attributes:
        faults: Faults.
        trials: Trials, at least.
        pace: Seconds a second of a trial takes.
        plain_share: The plain client gets one in so many of both.
        daemon_faults: Faults that befall a daemon.
        losses: How often a client is lost in a trial on the emulated hardware, by each signal.
        stops: Emergency stops.
    """

    faults: int
    trials: int
    pace: float
    plain_share: int
    daemon_faults: int
    losses: int
    stops: int


QUICK = Extent(faults=9, trials=30, pace=0.05, plain_share=3, daemon_faults=4, losses=1, stops=50)


def conduct(
    extent: Extent, seed: int, folder: Path, *, plain: bool, say: Callable[[str], None]
) -> dict[str, Any]:
    """One campaign, and all there is to say of it."""
    share = extent.plain_share if plain else 1
    trials = extent.trials // share
    search = min(SEARCH_TRIALS, max(trials - BESIDE_SEARCH, 10))
    schedule = faults.schedule(extent.faults // share, seed)
    with Stand(folder, plain=plain, pace=extent.pace) as stand:
        campaign = Campaign(stand, schedule, search, seed)
        campaign.run(-(-trials // (search + BESIDE_SEARCH)), say)
    diary = campaign.diary
    for text in diary.unnamed:
        say(text)
    return {
        "faults": sum(diary.faults.values()),
        "faults_by_kind": dict(sorted(diary.faults.items())),
        "client_exits": {str(code): n for code, n in sorted(diary.exits.items())},
        "stuck": diary.stuck,
        "twins_served": diary.twins,
        "unnamed_errors": len(diary.unnamed),
        **verdict.figures(verdict.judge(stand, diary)),
    }


def lost_clients(times: int, folder: Path) -> dict[str, Any]:
    """How soon the emulated hardware is safe when its client is gone."""
    found: dict[str, Any] = {"dead_man_not_restored": 0}
    for name, number in (("killed", signal.SIGKILL), ("frozen", signal.SIGSTOP)):
        escapes = deadman.escapes(folder, number, times)
        found[f"client_{name}_restored_max_s"] = max(e.restored_s for e in escapes)
        found[f"client_{name}_restored_median_s"] = statistics.median(
            e.restored_s for e in escapes
        )
        found[f"client_{name}_left_max_s"] = max(e.left_s for e in escapes)
        found["dead_man_not_restored"] += sum(not e.restored for e in escapes)
    return found


def emergency_stops(turns: int, folder: Path) -> dict[str, float]:
    """How soon an emergency stop is answered while others pull records as fast as they can."""
    watch = benchmark_link.Stopwatch()
    with (
        benchmark_link.started("--serve", "--folder", str(folder)) as (endpoint, *_),
        benchmark_link.started("--pull", endpoint),
        zenoh.connect(endpoint) as rig,
    ):
        benchmark_link.stops(rig, watch, "stop", turns)
    return {"stop_median_ms": watch.median_ms("stop"), "stop_p99_ms": watch.slow_ms("stop")}


def targets_of(figures: dict[str, Any]) -> dict[str, Target]:
    """What has to be reached."""
    limits: dict[str, float] = dict.fromkeys(NONE, 0)
    limits |= {name: deadman.LIMIT_S for name in figures if name.endswith("_restored_max_s")}
    limits["stop_p99_ms"] = benchmark_link.STOP_LIMIT_MS
    found = {name: at_most(figures[name], limit) for name, limit in limits.items()}
    daemon = {f"daemon_{name}": at_most(figures["daemon"][name], 0) for name in supervised.NONE}
    return found | daemon


def show(figures: dict[str, Any], seconds: float) -> None:
    """Prints the tables."""
    ours, theirs = figures, figures["plain"]
    print(f"{'':56}{'estune':>10}{'plain':>10}")
    for name, words in WORDS.items():
        print(f"{words:56}{ours[name]:10}{theirs[name]:10}")
    print("\nfaults, each in both columns' share:")
    _show_kinds(ours)
    codes = ", ".join(f"{n} with {code}" for code, n in ours["client_exits"].items())
    print(f"clients that ended: {codes}; {seconds:.0f} s in all")
    print("\na daemon that tunes, again and again:")
    for name, words in supervised.WORDS.items():
        print(f"{words:68}{figures['daemon'][name]:10}")
    _show_kinds(figures["daemon"])
    print("\nclient lost in a trial on the emulated hardware: until its own gains are live again,")
    print("until the reel has left the level of the trial")
    for name in ("killed", "frozen"):
        middle, worst, left = (
            figures[f"client_{name}_{what}_s"]
            for what in ("restored_median", "restored_max", "left_max")
        )
        print(f"  {name}: {middle:.3f} s (at most {worst:.3f}), at most {left:.3f} s")
    print(
        f"\nemergency stop under full record load: {figures['stop_median_ms']:.2f} ms, slowest "
        f"hundredth {figures['stop_p99_ms']:.2f} ms"
    )


def _show_kinds(figures: dict[str, Any]) -> None:
    for kind, count in figures["faults_by_kind"].items():
        print(f"  {count:5}  {kind}")


def main() -> int:
    """Runs everything; returns 1 where a target is missed."""
    parser = command_line(about, quick="nine faults")
    parser.add_argument("--faults", type=int, default=500)
    parser.add_argument("--trials", type=int, default=1000)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--keep", type=Path, help="where to leave logs, ledgers and journals")
    arguments = parser.parse_args()
    extent = QUICK
    if not arguments.quick:
        extent = Extent(arguments.faults, arguments.trials, 0.2, 4, 140, 20, 2000)

    def say(text: str) -> None:
        print(text, file=sys.stderr, flush=True)

    began_s = time.monotonic()
    with contextlib.ExitStack() as opened:
        folder = arguments.keep or Path(
            opened.enter_context(tempfile.TemporaryDirectory(prefix="estune-chaos-"))
        )
        parts = {name: folder / name for name in PARTS}
        for part in parts.values():
            part.mkdir(parents=True)
        seed = arguments.seed
        figures = conduct(extent, seed, parts["estune"], plain=False, say=say)
        figures["plain"] = conduct(extent, seed, parts["plain"], plain=True, say=say)
        figures["daemon"] = supervised.conduct(
            extent.daemon_faults, seed, QUICK.pace, parts["daemon"]
        )
        figures |= lost_clients(extent.losses, parts["hardware"])
        figures |= emergency_stops(extent.stops, parts["stops"])
    if not arguments.json:
        show(figures, time.monotonic() - began_s)
    return tell(figures, targets_of(figures), as_json=arguments.json)


if __name__ == "__main__":
    sys.exit(main())
