"""Is a trial run twice or lost, or do wrong gains stay live, under faults between real processes?

Command: `python -m experiments.chaos --faults 500`.
Target: no violation; 95 % of tunings finish in spite of an outage; a reel without its client is
safe in time.

Tunings run in a client process on a rig process. Meanwhile the experiment cuts
and stalls the connections between them, kills and freezes both, sends commands twice, late and out
of order, starts second rigs and second clients, floods the rig and fills its disk and the
client's. Violations are counted from the rig's own log of its motions, from its ledger and from
the client's journal. Beside it a daemon that tunes repeatedly is killed, frozen, stopped,
disconnected and denied its disk; the gains that were ever live are counted from the rig's log.
Finally clients are killed and frozen during trials on the emulated hardware, and the time until
the reel is safe is measured.
"""

import contextlib
import json
import signal
import statistics
import sys
import tempfile
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any, NamedTuple

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
"""Counts that must be zero: see `verdict.WORDS`; times no trial ran without a fault, second
processes admitted to the rig's ledger, clients that ended with an undocumented error."""

NONE_IN_OUTAGES = ("run_twice", "lost_records", "gains_left")


class Extent(NamedTuple):
    """Numbers of faults, trials, clients lost on the emulated hardware, tunings with an outage.

    `pace` is the real time per time of a trial.
    """

    faults: int
    trials: int
    pace: float
    daemon_faults: int
    losses: int
    outages: int
    durations: faults.Durations = faults.DURATIONS


QUICK = Extent(*(6, 20), pace=0.05, daemon_faults=2, losses=1, outages=1, durations=faults.SHORT)


def run_campaign(
    extent: Extent, seed: int, folder: Path, report: Callable[[str], None]
) -> dict[str, Any]:
    """Figures of one campaign, and of the tunings with outages of the network that follow."""
    search = min(SEARCH_TRIALS, max(extent.trials - BESIDE_SEARCH, 10))
    kinds, durations = list(faults.LinkFault), extent.durations
    schedule = faults.schedule(kinds, PAUSES_TRIALS, extent.faults, seed, durations)
    with Stand(folder, extent.pace) as stand:
        campaign = Campaign(stand, schedule, search, seed)
        campaign.run(-(-extent.trials // (search + BESIDE_SEARCH)), report)
        alone = _suffer_outages(stand, extent, seed, report)
    diary, apart = campaign.diary, verdict.count_violations(stand, alone)
    for text in diary.unnamed:
        report(text)
    return {
        "faults": sum(diary.faults.values()),
        "faults_by_kind": dict(sorted(diary.faults.items())),
        "client_exits": {str(code): n for code, n in sorted(diary.exits.items())},
        "stuck": diary.stuck,
        "twins_served": diary.twins,
        "unnamed_errors": len(diary.unnamed),
        **verdict.count_violations(stand, diary),
        "outages": {
            "outages": alone.faults.total(),
            "finished_share": 1.0 - len(alone.given_up) / len(alone.errands),
            **{name: apart[name] for name in NONE_IN_OUTAGES},
        },
    }


def _suffer_outages(
    stand: Stand, extent: Extent, seed: int, report: Callable[[str], None]
) -> Diary:
    """Course of tunings with an outage of the network in each, and no other fault."""
    count = extent.outages
    schedule = faults.schedule(
        [faults.LinkFault.OUTAGE], (1, 4, 10), count, seed, extent.durations
    )
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


def targets_of(figures: dict[str, Any]) -> dict[str, Target]:
    """The targets."""
    limits: dict[str, float] = dict.fromkeys(NONE, 0)
    limits |= {name: deadman.LIMIT_S for name in figures if name.endswith("_restored_max_s")}
    targets = {name: at_most(figures[name], limit) for name, limit in limits.items()}
    daemon = {f"daemon_{name}": at_most(figures["daemon"][name], 0) for name in supervised.NONE}
    outages = {f"outages_{name}": at_most(figures["outages"][name], 0) for name in NONE_IN_OUTAGES}
    finished = at_least(figures["outages"]["finished_share"], FINISHED_LEAST)
    return targets | daemon | outages | {"outages_finished_share": finished}


def measure(
    extent: Extent, seed: int, folder: Path, report: Callable[[str], None]
) -> dict[str, Any]:
    """Figures of all parts, each in a folder of its own; clients and daemon run side by side."""

    def part(name: str, run: Callable[..., dict[str, Any]], *arguments: Any) -> dict[str, Any]:
        """Figures of a part; kept, for those of a long campaign must outlive a later fault."""
        (place := folder / name).mkdir(parents=True)
        found = run(*arguments, folder=place)
        (place / "figures.json").write_text(json.dumps(found), encoding="utf-8")
        return found

    def daemon_part(folder: Path) -> dict[str, Any]:
        faults_of_daemon = (extent.daemon_faults, seed, QUICK.pace)
        return supervised.run_campaign(*faults_of_daemon, folder, extent.durations)

    def client_part(folder: Path) -> dict[str, Any]:
        return run_campaign(extent, seed, folder, report)

    with ThreadPoolExecutor(1) as beside:
        clients = beside.submit(part, "client", client_part)
        daemon = part("daemon", daemon_part)
    return clients.result() | {"daemon": daemon} | part("hardware", lose_clients, extent.losses)


def main() -> int:
    """Runs everything; returns 1 where a target is missed."""
    parser = command_line(__doc__, quick="six faults of the link, two of the daemon")
    parser.add_argument("--faults", type=int, default=500)
    parser.add_argument("--trials", type=int, default=1000)
    parser.add_argument(
        "--daemon-faults", type=int, default=140, help="and a seventh as many clients and outages"
    )
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--keep", type=Path, help="folder for logs, ledgers and journals")
    arguments = parser.parse_args()
    extent = QUICK
    if not arguments.quick:
        daemon, seventh = arguments.daemon_faults, arguments.daemon_faults // 7
        extent = Extent(arguments.faults, arguments.trials, 0.2, daemon, seventh, seventh)

    def report(text: str) -> None:
        print(text, file=sys.stderr, flush=True)

    with contextlib.ExitStack() as opened:
        folder = arguments.keep or Path(
            opened.enter_context(tempfile.TemporaryDirectory(prefix="estune-chaos-"))
        )
        figures = measure(extent, arguments.seed, folder, report)
    return print_results(figures, targets_of(figures), as_json=arguments.json, tables=True)


if __name__ == "__main__":
    sys.exit(main())
