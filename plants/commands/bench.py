"""`estune bench`: the force that a reel exerts while the far end of its cable moves."""

import time
from collections.abc import Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from cyclopts import Parameter
from rich.text import Text

from estune import api
from estune.cli import output
from estune.cli.runs import find_run
from estune.cli.values import (
    Json,
    RunsFolder,
    Values,
    check_folder_exists,
    numbers_from,
    security_from,
)
from estune.core.gains import GAIN_NAMES, Gains
from estune.errors import InvalidInput
from estune.run.journal import RUNS

if TYPE_CHECKING:
    from plants.bench.cable_platform.force_benches import TestedReel
    from plants.bench.felt_force.force_page import ReelForces
    from plants.bench.felt_force.force_procedure import ForceTest


def bench(
    targets: Values = (),
    /,
    *,
    run: Values = (),
    gain: Values = (),
    force: Annotated[tuple[float, ...], Parameter(negative=(), show_default=False)] = (),
    outside: Path | None = None,
    drum_radius: float = 0.025,
    part: float = 9.0,
    seed: int = 0,
    folder: RunsFolder = Path(RUNS),
    report: Path = Path("bench.html"),
    json: Json = False,
    security: Path | None = None,
) -> None:
    """Measure the force felt at a reel's cable while its end moves, by an outside sensor.

    Felt force, its hysteresis and bandwidth are measured with the gains before and after tuning.
    Rigs keep the live gains that they had. Stop with Ctrl-C: the reels return to their hold
    tension within 0.2 s.

    Args:
        targets: One or two endpoints of rigs that follow setpoints, or models of reels. Two are
            face to face, and each is tested while the other moves the far end. At one endpoint
            the far end is moved otherwise, by hand. By default a simulated reel is tested.
        run: The run whose tuned gains are tested, before them those it began from; one for each
            reel, or one for all.
        gain: A gain after tuning, as P=1.05; repeat for others. Those before are the live ones.
        force: Constant force, N; repeat for others. By default the least and the preload.
        outside: File of the outside sensor, with columns time_s (Unix time) and force_N, written
            during the test. By default the rig's own outside channel, or the other reel's gauge.
        drum_radius: Drum radius of rigs, m.
        part: Duration of each of the three parts of a test, s.
        seed: Seed of simulated noise.
        report: File of the report page.
        security: Credentials file, if a rig requires authentication.
    """
    from estune.support.html_page import write  # noqa: PLC0415  slow to import
    from plants.bench.cable_platform.force_benches import open_benches  # noqa: PLC0415  as above
    from plants.bench.felt_force.force_page import COLUMNS, headline, page  # noqa: PLC0415  as above
    from plants.bench.felt_force.force_procedure import ForceTest  # noqa: PLC0415  as above

    check_folder_exists("--report", report)
    if len(run) > 1 and len(run) != len(targets):
        raise InvalidInput(f"{len(run)} runs for {len(targets)} reels; give one, or one for each")
    test, reels = ForceTest(part_s=part), []
    with open_benches(targets, drum_radius, security_from(security), seed) as tested:
        for n, reel in enumerate(tested):
            gains = _gains(reel, run[min(n, len(run) - 1)] if run else None, gain, folder)
            limits, preload = reel.about.limits, reel.about.step.preload_N
            forces = force or (limits.tension_min_N, preload)
            for command in forces:
                limits.check_setpoint(command)
                limits.check_setpoint(command + test.oscillation_N)
            reels.append(_measure(reel, gains, forces, test, outside, quiet=json))
    source = f"that of {outside}" if outside else "that of the sensor outside, or the other reel"
    write(page(reels, source), report)
    if json:
        output.print_json(_plain(reels))
        return
    heads = ("reel", "at (N)", "gains", *COLUMNS.values())
    output.show_table(heads, [row for reel in reels for row in reel.rows()])
    for note in (headline(reels), *(note for reel in reels for note in reel.stalls())):
        output.show_line(note)
    output.show_next({"page": report})


def _gains(reel: "TestedReel", run: str | None, gain: Values, folder: Path) -> dict[str, Gains]:
    """Gains before and after tuning; one set if only one is known."""
    if run is not None and gain:
        raise InvalidInput("--run and --gain both name the gains after tuning; leave one out")
    if run is not None:
        result = api.load(find_run(run, folder))
        return {"before": result.start_gains, "after": result.gains}
    if not gain:
        return {"before": reel.about.gains}
    numbers = numbers_from(gain)
    if unknown := set(numbers) - set(GAIN_NAMES):
        raise InvalidInput(f"--gain {', '.join(unknown)}: the gains are {', '.join(GAIN_NAMES)}")
    return {"before": reel.about.gains, "after": replace(reel.about.gains, **numbers)}


def _measure(
    reel: "TestedReel",
    gains: dict[str, Gains],
    forces: Sequence[float],
    test: "ForceTest",
    outside: Path | None,
    *,
    quiet: bool,
) -> "ReelForces":
    from plants.bench.felt_force.felt_force import felt_force  # noqa: PLC0415  slow to import
    from plants.bench.felt_force.force_page import ReelForces  # noqa: PLC0415  as above
    from plants.bench.felt_force.outside_force import with_outside_force  # noqa: PLC0415  as above

    records, figures = {}, {}
    for name, own in gains.items():
        reel.bench.use(own)
        found = []
        for command in forces:
            if not quiet:
                text = f"reel {reel.label}, gains {name}, {command:g} N: {test.duration_s:.0f} s"
                output.console().print(Text(text, style="dim"))
            found.append(test.run(reel.bench, command))
        if outside is not None:
            clock_s = time.time() - time.monotonic()
            found = [with_outside_force(record, outside, clock_s) for record in found]
        records[name] = found
        figures[name] = [felt_force(r, test, reel.bench.period_s) for r in found]
    return ReelForces(reel.label, gains, records, figures)


def _plain(reels: "Sequence[ReelForces]") -> dict[str, Any]:
    from plants.bench.felt_force.force_page import COLUMNS  # noqa: PLC0415  slow to import

    return {
        reel.label: {
            name: {
                "gains": asdict(reel.gains[name]),
                "forces": [
                    {"command_N": each.command_N}
                    | {column: getattr(each, column) for column in COLUMNS}
                    for each in figures
                ],
            }
            for name, figures in reel.figures.items()
        }
        for reel in reels
    }
