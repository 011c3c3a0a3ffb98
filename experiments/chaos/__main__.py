"""`python -m experiments.chaos`: the tables, or with --json the figures."""

import contextlib
import json
import signal
import statistics
import sys
import tempfile
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any, NamedTuple

from estune.remote import zenoh
from experiments import benchmark_link
from experiments.chaos import __doc__ as about
from experiments.chaos import deadman, faults, supervised, verdict
from experiments.chaos.campaign import Campaign, Diary
from experiments.chaos.stand import Stand
from experiments.results import Target, at_least, at_most, command_line, print_results

SEARCH_TRIALS = 120
BESIDE_SEARCH = 9
OUTAGE_SEARCH_TRIALS = 20
FINISHED_LEAST = 0.95
"""Least share of tunings that finish by themselves, with an outage of the network in each."""
PAUSES_TRIALS = (0, 1, 1, 2, 4)
NONE = (
    *("run_twice", "overlapping", "unattended", "wrong_rig", "wrong_records", "lost_records"),
    *("gains_left", "other_proposals", "unfinished", "stuck", "twins_served", "unnamed_errors"),
    "dead_man_not_restored",
)
"""Counts that must be zero."""

WORDS = {
    "faults": "faults",
    **verdict.WORDS,
    "stuck": "times no trial ran without a fault",
    "twins_served": "second processes admitted to the rig's ledger",
    "unnamed_errors": "clients that ended with an undocumented error",
}


class Extent(NamedTuple):
    """Numbers of faults, trials, clients lost on the emulated hardware, and emergency stops.

    `pace` is the real time per time of a trial; `plain_share` divides both for the plain client.
    """

    faults: int
    trials: int
    pace: float
    plain_share: int
    daemon_faults: int
    losses: int
    stops: int
    outages: int
    durations: faults.Durations = faults.DURATIONS


QUICK = Extent(
    *(9, 20),
    pace=0.05,
    plain_share=9,
    daemon_faults=3,
    losses=1,
    stops=50,
    outages=1,
    durations=faults.SHORT,
)


def run_campaign(
    extent: Extent, seed: int, folder: Path, *, plain: bool, report: Callable[[str], None]
) -> dict[str, Any]:
    """Figures of one campaign; of estune's, tunings with outages of the network follow."""
    share = extent.plain_share if plain else 1
    trials = extent.trials // share
    search = min(SEARCH_TRIALS, max(trials - BESIDE_SEARCH, 10))
    count = extent.faults // share
    schedule = faults.schedule(list(faults.Kind), PAUSES_TRIALS, count, seed, extent.durations)
    with Stand(folder, plain=plain, pace=extent.pace) as stand:
        campaign = Campaign(stand, schedule, search, seed)
        campaign.run(-(-trials // (search + BESIDE_SEARCH)), report)
        alone = None if plain else _suffer_outages(stand, extent, seed, report)
    diary = campaign.diary
    for text in diary.unnamed:
        report(text)
    figures = {
        "faults": sum(diary.faults.values()),
        "faults_by_kind": dict(sorted(diary.faults.items())),
        "client_exits": {str(code): n for code, n in sorted(diary.exits.items())},
        "stuck": diary.stuck,
        "twins_served": diary.twins,
        "unnamed_errors": len(diary.unnamed),
        **verdict.count_violations(stand, diary),
    }
    if alone is not None:
        violations = verdict.count_violations(stand, alone)
        figures["outages"] = {
            "outages": alone.faults.total(),
            "finished_share": 1.0 - len(alone.given_up) / len(alone.errands),
            **{name: violations[name] for name in ("run_twice", "lost_records", "gains_left")},
        }
    return figures


def _suffer_outages(
    stand: Stand, extent: Extent, seed: int, report: Callable[[str], None]
) -> Diary:
    """Course of tunings with an outage of the network in each, and no other fault."""
    count = extent.outages
    schedule = faults.schedule([faults.Kind.OUTAGE], (1, 4, 10), count, seed, extent.durations)
    campaign = Campaign(stand, schedule, OUTAGE_SEARCH_TRIALS, seed, name="outage")
    campaign.run(count, report)
    return campaign.diary


def lose_clients(times: int, folder: Path) -> dict[str, Any]:
    """Figures of the emulated hardware without its client."""
    figures: dict[str, Any] = {"dead_man_not_restored": 0}
    names = {signal.SIGKILL: "killed", signal.SIGSTOP: "frozen"}
    for number, escapes in deadman.escapes(folder, list(names), times).items():
        name = names[signal.Signals(number)]
        restored = [escape.restored_s for escape in escapes]
        figures[f"client_{name}_restored_max_s"] = max(restored)
        figures[f"client_{name}_restored_median_s"] = statistics.median(restored)
        figures[f"client_{name}_left_max_s"] = max(e.left_s for e in escapes)
        figures["dead_man_not_restored"] += sum(not e.restored for e in escapes)
    return figures


def stop_under_load(turns: int, folder: Path) -> dict[str, float]:
    """Reply time of an emergency stop while other clients query records at full rate."""
    watch = benchmark_link.Stopwatch()
    with (
        benchmark_link.started("--serve", "--folder", str(folder)) as (endpoint, *_),
        benchmark_link.started("--pull", endpoint),
        zenoh.connect(endpoint) as rig,
    ):
        benchmark_link.stops(rig, watch, "stop", turns)
    return {"stop_median_ms": watch.median_ms("stop"), "stop_p99_ms": watch.slow_ms("stop")}


def targets_of(figures: dict[str, Any]) -> dict[str, Target]:
    """The targets."""
    limits: dict[str, float] = dict.fromkeys(NONE, 0)
    limits |= {name: deadman.LIMIT_S for name in figures if name.endswith("_restored_max_s")}
    limits["stop_p99_ms"] = benchmark_link.STOP_LIMIT_MS
    targets = {name: at_most(figures[name], limit) for name, limit in limits.items()}
    daemon = {f"daemon_{name}": at_most(figures["daemon"][name], 0) for name in supervised.NONE}
    outages = {
        f"outages_{name}": at_most(figures["outages"][name], 0)
        for name in ("run_twice", "lost_records", "gains_left")
    }
    finished = at_least(figures["outages"]["finished_share"], FINISHED_LEAST)
    return targets | daemon | outages | {"outages_finished_share": finished}


def show(figures: dict[str, Any], seconds: float) -> None:
    """Prints the tables."""
    ours, theirs = figures, figures["plain"]
    print(f"{'':56}{'estune':>10}{'plain':>10}")
    for name, words in WORDS.items():
        print(f"{words:56}{ours[name]:10}{theirs[name]:10}")
    print("\nfaults:")
    _show_kinds(ours)
    alone = figures["outages"]
    print(
        f"{alone['outages']} tunings with an outage of the network each: "
        f"{alone['finished_share']:.0%} finished by themselves"
    )
    codes = ", ".join(f"{n} with {code}" for code, n in ours["client_exits"].items())
    print(f"clients by exit code: {codes}; {seconds:.0f} s in total")
    print("\ndaemon that tunes repeatedly:")
    for name, words in supervised.WORDS.items():
        print(f"{words:68}{figures['daemon'][name]:10}")
    _show_kinds(figures["daemon"])
    print("\nclient lost during a trial on the emulated hardware: time until its own gains are")
    print("live again, and until the reel has left the level of the trial")
    for name in ("killed", "frozen"):
        median, worst, left = (
            figures[f"client_{name}_{what}_s"]
            for what in ("restored_median", "restored_max", "left_max")
        )
        print(f"  {name}: median {median:.3f} s (at most {worst:.3f}), at most {left:.3f} s")
    median, slow = figures["stop_median_ms"], figures["stop_p99_ms"]
    print(
        f"\nemergency stop under record load: median {median:.2f} ms, 99th centile {slow:.2f} ms"
    )


def _show_kinds(figures: dict[str, Any]) -> None:
    for kind, count in figures["faults_by_kind"].items():
        print(f"  {count:5}  {kind}")


def measure(
    extent: Extent, seed: int, folder: Path, report: Callable[[str], None]
) -> dict[str, Any]:
    """Figures of all parts, each in a folder of its own; estune's beside the next two."""

    def part(name: str, run: Callable[..., dict[str, Any]], *before: Any, **options: Any) -> Any:
        """Figures of a part; kept, for those of a long campaign must outlive a later fault."""
        (place := folder / name).mkdir(parents=True)
        found = run(*before, folder=place, **options)
        (place / "figures.json").write_text(json.dumps(found), encoding="utf-8")
        return found

    of_both: dict[str, Any] = {"extent": extent, "seed": seed, "report": report}
    with ThreadPoolExecutor(1) as beside:
        ours = beside.submit(part, "estune", run_campaign, plain=False, **of_both)
        plain = part("plain", run_campaign, plain=True, **of_both)
        faults_of_daemon = (extent.daemon_faults, seed, QUICK.pace)
        durations = extent.durations
        daemon = part("daemon", supervised.run_campaign, *faults_of_daemon, durations=durations)
        figures = ours.result() | {"plain": plain, "daemon": daemon}
    figures |= part("hardware", lose_clients, extent.losses)
    return dict(figures | part("stops", stop_under_load, extent.stops))


def main() -> int:
    """Runs everything; returns 1 where a target is missed."""
    parser = command_line(
        about, quick="nine faults of estune, one of the plain client, three of the daemon"
    )
    parser.add_argument("--faults", type=int, default=500)
    parser.add_argument("--trials", type=int, default=1000)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--keep", type=Path, help="folder for logs, ledgers and journals")
    arguments = parser.parse_args()
    extent = QUICK
    if not arguments.quick:
        extent = Extent(arguments.faults, arguments.trials, 0.2, 4, 140, 20, 2000, 20)

    def report(text: str) -> None:
        print(text, file=sys.stderr, flush=True)

    began_s = time.monotonic()
    with contextlib.ExitStack() as opened:
        folder = arguments.keep or Path(
            opened.enter_context(tempfile.TemporaryDirectory(prefix="estune-chaos-"))
        )
        figures = measure(extent, arguments.seed, folder, report)
    if not arguments.json:
        show(figures, time.monotonic() - began_s)
    return print_results(figures, targets_of(figures), as_json=arguments.json)


if __name__ == "__main__":
    sys.exit(main())
