"""`estune records`: how recorded data are understood, and the same data in estune's own form."""

import json as json_text
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from rich.text import Text

from estune.cli import output
from estune.cli.values import Json, Values, command_line, words_from
from estune.errors import InvalidInput
from plants.commands.columns import Sources, column_map

if TYPE_CHECKING:
    from estune.recordings.issue import DataIssue
    from estune.recordings.units import Drum
    from estune.service_records.usable import JudgedLogs, JudgedStretch
    from plants.diagnosis.data.measured_record import MeasuredRecord
    from plants.diagnosis.data.records import ColumnSource
    from plants.explain_page.preview import Preview

COMMANDS_SHOWN = 12
SHOWN = 60


def records(
    data: Path,
    /,
    *,
    map_: Sources = (),
    unit: Values = (),
    scale: Values = (),
    save_map: Path | None = None,
    model: str | None = None,
    out: Path | None = None,
    form: Literal["csv", "parquet", "mcap"] = "csv",
    json: Json = False,
) -> None:
    """Show how recorded data are understood: columns, units, rate, gaps, trials and signs.

    Of logs of a running loop it also shows which stretches estune suggest can use.

    Args:
        data: A file or a folder of them, or runs: tables, Parquet, MATLAB, ROS bags, MCAP, TDMS,
            spreadsheets, logs of firmware and historians.
        map_: Where the columns come from: time=t,current=vir,angle=qm, or a TOML file of them; of
            the log of a loop time=t,setpoint=sp,measurement=pv,effort=out.
        unit: Their units, such as angle=mm,tension=lbf.
        scale: Factors to the unit, such as current=35.15.
        save_map: Write the map as a TOML file, for --map.
        model: The model whose drum turns lengths into angles and torques into currents.
        out: Folder for the records as a model's diagnosis takes them, one file each.
        form: Format of these files.

    Raises:
        InvalidInput: there is no record, or an option cannot be used.
    """
    from plants.diagnosis.data.records import read_measurements  # noqa: PLC0415
    from plants.explain_page.preview import preview, warnings  # noqa: PLC0415  as above

    named = _named(map_)
    if {"measurement", "effort"} & named.keys():  # channels of a loop's log alone
        _show_logs(_logs(data, named), json=json)
        return
    is_for_logs = named.keys() <= {"time", "setpoint"}
    columns, drum = column_map(map_, unit, scale, save_map), _drum(model)
    try:
        logs = _logs(data, named if is_for_logs else {})
    except InvalidInput:  # no log of a running loop
        logs = None
    try:
        contents = read_measurements(data, columns, drum)
    except InvalidInput as error:
        # A log that was read without the map would be called usable, though the map is wrong.
        if logs is None or out is not None or not is_for_logs:
            raise
        _show_logs(logs, str(error), json=json)
        return
    stretches = logs.stretches if logs else []
    previews = [preview(m) for m in contents.measurements]
    signs = {p.name: warnings(p) for p in previews}
    if out is not None:
        for m in contents.measurements:
            _write(m, out, form)
    if json:
        output.print_json(
            {
                "records": previews,
                "columns": contents.sources,
                "findings": contents.findings,
                "signs": signs,
                "stop": _stop(data),
                "service": stretches,
            }
        )
        return
    output.show_doubts(contents.findings)
    _show(previews, contents.sources)
    _show_stop(_stop(data))
    _show_doubts(contents.findings, signs)
    if stretches:
        print()
        _show_stretches(stretches)
    if out is not None:
        output.show_next(
            {"records": out, "explain": command_line("explain", model="MODEL", data=out)}
        )


def _drum(model: str | None) -> "Drum":
    from estune.recordings.units import NO_DRUM  # noqa: PLC0415  slow to import

    if model is None:
        return NO_DRUM
    import plants  # noqa: PLC0415  slow to import
    from plants.diagnosis.data.records import drum_of  # noqa: PLC0415  as above

    return drum_of(plants.load_model(model))


def _named(sources: Iterable[str]) -> dict[str, str]:
    """The columns by channel that a map names on the command line."""
    return words_from("--map", [text for text in sources if "=" in text])


def _logs(data: Path, sources: Mapping[str, str]) -> "JudgedLogs":
    from estune.service_records.usable import judged_logs  # noqa: PLC0415  slow to import

    return judged_logs(data, sources)


def _show_logs(logs: "JudgedLogs", why: str = "", *, json: bool) -> None:
    """Shows logs of a loop that are no records of a reel or a drive."""
    if json:
        output.print_json({"service": logs.stretches, "not_for_explain": why})
        return
    output.show_doubts(logs.issues)
    output.show_table(("file", "column", "from", "unit"), logs.columns)
    print()
    _show_stretches(logs.stretches)
    _show_doubts(logs.issues, {})
    if why:
        _line("warning", f"for estune suggest only: {why}")


def _show_stretches(stretches: list["JudgedStretch"]) -> None:
    rows = (
        (s.log, f"{s.start_s:.4g}", f"{s.stop_s:.4g}", s.reason or "usable") for s in stretches
    )
    output.show_table(("log", "from s", "to s", "estune suggest"), rows)


def _stop(data: Path) -> dict[str, Any]:
    """What the black box of a rig says of the stop it was copied at; empty for other data."""
    from estune.recordings.black_box_file import ENDING  # noqa: PLC0415  slow to import
    from estune.recordings.metadata import metadata_beside  # noqa: PLC0415  as above

    about = metadata_beside(data) if data.suffix == ENDING else {}
    return {name: about[name] for name in ("at", "reason", "commands") if name in about}


def _short(value: Any) -> str:
    """JSON without the lease, which says nothing, cut off where it is long."""
    kept = (
        {k: v for k, v in value.items() if v and k != "lease"}
        if isinstance(value, dict)
        else value
    )
    text = json_text.dumps(kept)
    return text if len(text) <= SHOWN else f"{text[: SHOWN - 3]}..."


def _show_stop(stop: dict[str, Any]) -> None:
    if not stop:
        return
    print()
    print(f"stopped at {stop['at']}: {stop['reason']}")
    rows = (
        (c["at"], c["verb"], _short(c["command"]), _short(c["answer"]))
        for c in stop.get("commands", ())[-COMMANDS_SHOWN:]
    )
    output.show_table(("at", "command", "payload", "answer"), rows)


def _show(previews: list["Preview"], sources: tuple["ColumnSource", ...]) -> None:
    from plants.diagnosis.data.measured_record import CHANNELS  # noqa: PLC0415  slow to import

    output.show_table(
        ("file", "column", "from", "unit", "factor"),
        ((*source[:4], f"{source.factor:.7g}") for source in sources),
    )
    print()
    columns = [n for n in CHANNELS if any(n in p.ranges for p in previews)]
    output.show_table(
        ("record", "rate Hz", "seconds", "loop", "steps", *columns),
        (
            (
                *(p.name, f"{p.sampling_Hz:.6g}", f"{p.duration_s:.4g}"),
                p.loop if "setpoint_N" in p.ranges else "-",
                "-" if p.steps is None else str(p.steps),
                *(_range(p.ranges.get(name)) for name in columns),
            )
            for p in previews
        ),
    )
    for p in previews:
        signs = ", ".join(f"{pair} {value:+.2f}" for pair, value in p.signs.items())
        _line("signs", f"{p.name}: {signs}")


def _show_doubts(findings: Iterable["DataIssue"], signs: Mapping[str, Iterable[str]]) -> None:
    for issue in findings:
        if issue.level != "doubt":  # said above
            _line(issue.level, str(issue))
    for name, sentences in signs.items():
        for sentence in sentences:
            _line("warning", f"{name}: {sentence}")


def _range(ends: tuple[float, float] | None) -> str:
    return "-" if ends is None else f"{ends[0]:.3g} to {ends[1]:.3g}"


def _line(level: str, sentence: str) -> None:
    style = {"refused": "red", "warning": "yellow"}.get(level, "dim")
    output.console().print(Text.assemble((f"{level}  ", style), sentence), soft_wrap=True)


def _write(m: "MeasuredRecord", folder: Path, form: Literal["csv", "parquet", "mcap"]) -> None:
    from estune.core.gains import GAIN_NAMES  # noqa: PLC0415  slow to import
    from estune.recordings.record_files import write_columns  # noqa: PLC0415
    from plants.diagnosis.data.measured_record import CHANNELS  # noqa: PLC0415

    named = {name: m.channel(name) for name in CHANNELS}
    columns: dict[str, object] = {"time_s": m.time_s}
    columns |= {n: c for n, c in named.items() if c is not None}
    if m.flags is not None:
        columns["flags"] = m.flags
    gains = m.gains and dict(zip(GAIN_NAMES, m.gains.as_tuple(), strict=True))
    about = {
        "rig": m.rig,
        "trial_id": m.name,
        "sampling_Hz": m.sampling_Hz,
        "cable_length_m": m.cable_length_m,
        "preload_N": m.preload_N,
        "loop": m.loop,
        "gains": gains,
        "profile": m.profile,
    }
    folder.mkdir(parents=True, exist_ok=True)
    write_columns(columns, about, folder / m.name.replace("/", "_"), form)
