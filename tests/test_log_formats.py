"""Logs as programs and firmware write them: each read back, and their loops found by name."""

import json
import math
import struct

import numpy as np
import pytest

from estune.conformance.recordings import ReaderConformance, columns
from estune.recordings.issue import Unusable
from estune.recordings.loop_log import read_loop_log
from estune.service_records.sources import read_logs

COUNT = 120
K = np.arange(COUNT)
SETPOINT = 50.0 + 10.0 * (K // 30 % 2)
MEASURED = 50.0 + np.round(5.0 * np.sin(K / 9.0), 3)
EFFORT = 0.5 + np.round(0.3 * np.cos(K / 9.0), 3)
EPOCH_S = 1_700_000_000


def ulog(path, topics):
    """Topics of doubles by name, each with stamps in us and columns."""

    def message(kind, data):
        return struct.pack("<HB", len(data), ord(kind)) + data

    out = [b"ULog\x01\x12\x35\x01" + struct.pack("<Q", 0)]
    for topic, (_, signals) in topics.items():
        fields = "".join(f"double {name};" for name in signals)
        out.append(message("F", f"{topic}:uint64_t timestamp;{fields}".encode()))
    for number, topic in enumerate(topics):
        out.append(message("A", struct.pack("<BH", 0, number) + topic.encode()))
    for number, (stamps_us, signals) in enumerate(topics.values()):
        for us, *row in zip(stamps_us, *signals.values(), strict=True):
            data = struct.pack("<HQ", number, round(us)) + struct.pack(f"<{len(row)}d", *row)
            out.append(message("D", data))
    path.write_bytes(b"".join(out))


def dataflash(path, name, stamps_us, signals):
    """A message of doubles as ArduPilot logs it."""
    head = b"\xa3\x95"
    labels = ",".join(["TimeUS", *signals]).encode()
    kinds = "Q" + "d" * len(signals)
    length = 3 + 8 * len(kinds)
    own = struct.pack("<BB4s16s64s", 128, 89, b"FMT", b"BBnNZ", b"Type,Length,Name,Format,Columns")
    out = [head + b"\x80" + own]
    out.append(
        head + b"\x80" + struct.pack("<BB4s16s64s", 130, length, name, kinds.encode(), labels)
    )
    for us, *row in zip(stamps_us, *signals.values(), strict=True):
        out.append(head + b"\x82" + struct.pack(f"<Q{len(row)}d", round(us), *row))
    path.write_bytes(b"".join(out))


def untimed(written):
    return {name: values for name, values in written.items() if name != "time_s"}


class TestSpreadsheet(ReaderConformance):
    ending = ".xlsx"

    def write(self, path, written):
        book = pytest.importorskip("openpyxl").Workbook(write_only=True)
        sheet = book.create_sheet()
        sheet.append(list(written))
        for row in zip(*written.values(), strict=True):
            sheet.append([float(x) if np.isfinite(x) else str(x) for x in row])
        book.save(path)

    def test_columns_are_read_back_exactly(self, tmp_path):
        """To the 15 digits that a cell keeps."""
        self.write(tmp_path / "record.xlsx", columns())
        (part,) = self.read(tmp_path / "record.xlsx").parts
        for name, values in columns().items():
            np.testing.assert_allclose(part[name], values, rtol=1e-14, atol=1e-15)


class TestJsonLines(ReaderConformance):
    ending = ".jsonl"

    def write(self, path, written):
        rows = zip(*(values.tolist() for values in written.values()), strict=True)
        path.write_text(
            "".join(json.dumps(dict(zip(written, r, strict=True))) + "\n" for r in rows)
        )


class TestLineProtocol(ReaderConformance):
    ending = ".lp"
    stamp_s = 1e-9

    def write(self, path, written):
        fields = untimed(written)
        lines = [
            f"reel,rig=a {','.join(f'{n}={x!r}' for n, x in zip(fields, row, strict=True))} "
            f"{EPOCH_S * 10**9 + round(t * 1e9)}\n"
            for t, row in zip(
                written["time_s"],
                zip(*(v.tolist() for v in fields.values()), strict=True),
                strict=True,
            )
        ]
        path.write_text("".join(lines))


class TestUlog(ReaderConformance):
    ending = ".ulg"
    stamp_s = 1e-6

    def write(self, path, written):
        pytest.importorskip("pyulog")
        ulog(path, {"reel": (1e6 * written["time_s"], untimed(written))})


class TestDataflash(ReaderConformance):
    ending = ".bin"
    stamp_s = 1e-6

    def write(self, path, written):
        pytest.importorskip("pymavlink")
        dataflash(path, b"REEL", 1e6 * written["time_s"], untimed(written))


def check(log, rate=1.0, first=0):
    part = log.parts[0]
    assert len(log.parts) == 1
    assert log.sampling_Hz == pytest.approx(rate, rel=1e-3)
    for name, values in (("setpoint", SETPOINT), ("measurement", MEASURED), ("effort", EFFORT)):
        np.testing.assert_allclose(part[name], values[first:], atol=1e-9)


def klippy():
    for k in K:
        yield (
            f"Stats {900 + k}.0: gcodein=0  mcu: mcu_awake=0.004 bytes_write={k} "
            f"heater_bed: target=60 temp=60.0 pwm=0.100 "
            f"extruder: target={SETPOINT[k]:g} temp={MEASURED[k]:.3f} "
            f"pwm={EFFORT[k]:.3f} sysload=0.4"
        )


def marlin():
    for k in K:
        yield (
            f"12:{k // 60:02d}:{k % 60:02d}.000: Recv:  T:{MEASURED[k]:.3f} /{SETPOINT[k]:.2f} "
            f"B:60.00 /60.00 @:{EFFORT[k]:.3f} B@:32"
        )


def home_assistant():
    yield "entity_id,state,last_changed"
    for k in K:
        stamp = f"2026-01-05T10:{k // 60:02d}:{k % 60:02d}.000Z"
        yield f"sensor.boiler_temperature,{MEASURED[k]},{stamp}"
        if k == 0 or SETPOINT[k] != SETPOINT[k - 1]:
            yield f"number.boiler_target,{SETPOINT[k]},{stamp}"
        yield f"sensor.boiler_output,{EFFORT[k]},{stamp}"
        if k % 50 == 3:
            yield f"sensor.boiler_temperature,unavailable,{stamp[:-5]}.400Z"


def influx():
    yield "#group,false,false,true,true,false,false,true,true"
    yield f"#datatype,string,long,{'dateTime:RFC3339,' * 3}double,string,string"
    yield "#default,_result,,,,,,,"
    for table, (field, values) in enumerate(
        (("target", SETPOINT), ("temp", MEASURED), ("output", EFFORT))
    ):
        yield ",result,table,_start,_stop,_time,_value,_field,_measurement"
        for k in K:
            stamp = f"2026-01-05T10:{k // 60:02d}:{k % 60:02d}Z"
            begun = "2026-01-05T00:00:00Z,2026-01-06T00:00:00Z"
            yield f",,{table},{begun},{stamp},{values[k]},{field},oven"
        yield ""


def grafana():
    yield '"Time","Target","Temperature","Output"'
    for k in K:
        stamp = f"2026-01-05 10:{k // 60:02d}:{k % 60:02d}"
        yield f"{stamp},{SETPOINT[k]} °C,{MEASURED[k]} °C,{EFFORT[k]}"


def line_protocol():
    for k in K:
        ns = (EPOCH_S + int(k)) * 10**9
        fields = f"target={SETPOINT[k]},temp={MEASURED[k]},output={EFFORT[k]}"
        yield f'oven,room=a\\ b {fields},mode="heat, on" {ns}'


def json_lines():
    for k in K:
        row = {"ts": f"2026-01-05T10:{k // 60:02d}:{k % 60:02d}Z", "oven": {"target": SETPOINT[k]}}
        row["oven"] |= {"temp": MEASURED[k], "output": EFFORT[k]}
        yield json.dumps(row)


def labview():
    yield from ("LabVIEW Measurement\t", "Separator\tTab", "Decimal_Separator\t,", "X_Columns\tNo")
    yield from ("***End_of_Header***\t", "\t", "Channels\t3\t\t\t", "Y_Unit_Label\tV\tV\tV\t")
    yield from ("Delta_X\t1,0\t1,0\t1,0\t", "***End_of_Header***\t\t\t\t")
    yield "X_Value\tSetpoint\tMeasured\tOutput\tComment"
    for k in K:
        yield "\t".join(
            ["", *(f"{x[k]:.3f}".replace(".", ",") for x in (SETPOINT, MEASURED, EFFORT))]
        )


def betaflight():
    names = [f"{n}[{a}]" for n in ("axisP", "axisI", "setpoint", "gyroADC") for a in range(3)]
    yield ", ".join(["loopIteration", "time (us)", *names])
    for k in K:
        rows = [
            [0.5 * EFFORT[k]] * 3,
            [0.5 * EFFORT[k]] * 3,
            [SETPOINT[k], 0, 0],
            [MEASURED[k], k, k],
        ]
        yield ", ".join(map(str, [k, 1_000_000 * k, *(x for row in rows for x in row)]))


@pytest.mark.parametrize(
    ("name", "lines", "sources"),
    [
        ("klippy.log", klippy, {"measurement": "extruder.temp"}),
        ("octoprint.log", marlin, {"measurement": "extruder.temp"}),
        ("history.csv", home_assistant, {}),
        ("influx.csv", influx, {}),
        ("grafana.csv", grafana, {}),
        ("oven.lp", line_protocol, {}),
        ("oven.jsonl", json_lines, {"time": "ts"}),
        ("oven.lvm", labview, {}),
        ("flight.csv", betaflight, {"measurement": "rate roll.measurement"}),
    ],
)
def test_log_of_a_loop_is_read_as_its_program_writes_it(tmp_path, name, lines, sources):
    path = tmp_path / name
    path.write_text("\n".join([*lines(), ""]), "utf-8")
    check(read_loop_log(path, sources))


def test_row_that_is_refused_is_that_of_the_file_after_rows_were_left_out(tmp_path):
    rows = [f"{k},{math.sin(k)},{math.sin(k - 1)},{k % 7}" for k in range(50)]
    rows[10] = "10,1.0,,3"  # no measurement
    rows[20] = rows[19]  # a copy
    rows[40] = "38,0.5,0.4,1"  # behind the row above
    path = tmp_path / "log.csv"
    path.write_text("\n".join(["time_s,setpoint,measurement,output", *rows]), "utf-8")
    with pytest.raises(Unusable, match="is before that of the row above") as refused:
        read_loop_log(path)
    assert refused.value.issue.row == 41


def test_loops_of_a_flight_are_listed_and_taken_by_name(tmp_path):
    pytest.importorskip("pyulog")
    us = 1_000_000 * K
    rates = {"roll": SETPOINT, "pitch": 0.0 * K, "yaw": 0.0 * K}
    gyro = {f"xyz[{k}]": v for k, v in enumerate((MEASURED, 1.0 * K, 1.0 * K))}
    effort = {f"xyz[{k}]": EFFORT for k in range(3)}
    path = tmp_path / "flight.ulg"
    topics = {"vehicle_rates_setpoint": (us, rates), "vehicle_angular_velocity": (us, gyro)}
    ulog(path, topics | {"vehicle_torque_setpoint": (us, effort)})
    with pytest.raises(Unusable, match=r"the loops rate roll, rate pitch, rate yaw; choose one"):
        read_loop_log(path)
    check(read_loop_log(path, {"measurement": "rate roll.measurement"}))


def test_loops_of_a_dataflash_log_are_listed(tmp_path):
    pytest.importorskip("pymavlink")
    columns = {"RDes": SETPOINT, "R": MEASURED, "ROut": EFFORT, "PDes": EFFORT, "P": EFFORT}
    path = tmp_path / "flight.bin"
    dataflash(path, b"RATE", 1_000_000 * K, columns)
    with pytest.raises(Unusable, match="the loops rate roll, rate pitch; choose one"):
        read_loop_log(path)
    check(read_loop_log(path, {"measurement": "rate roll.measurement"}))


DBC = """VERSION ""
BU_: ECU
BO_ 291 Oven: 8 ECU
 SG_ Target : 0|16@1+ (0.01,0) [0|655] "degC" ECU
 SG_ Actual : 16|16@1+ (0.001,0) [0|65] "degC" ECU
 SG_ Output : 32|16@1+ (0.001,0) [0|65] "" ECU
"""


@pytest.mark.parametrize(
    "form", ["({t:.6f}) can0 123#{joined}", " ({t:.6f})  can0  123   [8]  {parted}"]
)
def test_frames_are_decoded_by_the_dbc_beside_them(tmp_path, form):
    pytest.importorskip("cantools")
    lines = []
    for k in K:
        raw = struct.pack(
            "<HHHH", round(100 * SETPOINT[k]), round(1e3 * MEASURED[k]), round(1e3 * EFFORT[k]), 0
        )
        shown = {"joined": raw.hex().upper(), "parted": raw.hex(" ").upper()}
        lines.append(form.format(t=EPOCH_S + k, **shown))
    path = tmp_path / "candump.log"
    path.write_text("\n".join(lines))
    with pytest.raises(Unusable, match=r"there is none; put it beside, as candump\.dbc"):
        read_loop_log(path)
    path.with_suffix(".dbc").write_text(DBC)
    log = read_loop_log(path)
    check(log)
    assert log.units["measurement"] == "degC"


def test_reports_of_uneven_times_are_held_until_the_next(tmp_path):
    random = np.random.default_rng(3)
    stamps = np.cumsum(random.uniform(1.0, 30.0, 200))
    measured = np.cumsum(random.choice([-0.5, 0.5], 200))
    rows = [f"room temperature,{y},{t:.3f}" for t, y in zip(stamps, measured, strict=True)]
    rows += [f"room target,{20 + n},{stamps[0] + 700.0 * n:.3f}" for n in range(4)]
    path = tmp_path / "log.csv"
    path.write_text("\n".join(["name,value,time_s", *rows]))
    log = read_loop_log(path)
    (part,) = log.parts
    assert any("reports on change" in issue.sentence for issue in log.issues)
    steps = np.diff(stamps)
    assert log.sampling_Hz == pytest.approx(1.0 / np.median(steps), rel=1e-3)
    time_s = part["time"] - part["time"][0]
    last = np.searchsorted(stamps - stamps[0], time_s, side="right") - 1
    between = np.minimum(measured[last], measured[np.minimum(last + 1, 199)])
    assert (part["measurement"] >= between - 1e-9).all()
    assert (np.diff(part["setpoint"]) > 0.0).sum() == 3


def test_log_of_another_rate_or_without_a_loop_is_left_out_and_named(tmp_path):
    for name, step in (("a", 0.01), ("b", 0.0101), ("c", 0.0099), ("slow", 0.5)):
        rows = [f"{step * k:.6f},{SETPOINT[k]},{MEASURED[k]}" for k in K]
        (tmp_path / f"{name}.csv").write_text("\n".join(["time_s,sp,pv", *rows]))
    (tmp_path / "notes.csv").write_text("who,what\nme,nothing\n")
    found = read_logs(tmp_path)
    assert [log.name for log in found.logs] == ["a.csv", "b.csv", "c.csv"]
    assert [log.sampling_Hz for log in found.logs] == pytest.approx([100.0] * 3)
    left_out = {issue.source for issue in found.issues if issue.level == "refused"}
    assert left_out == {"slow.csv", "notes.csv"}
    assert read_logs(tmp_path, None, 100.5).logs[0].sampling_Hz == pytest.approx(100.5)


def test_reports_of_a_printer_without_times_ask_for_the_rate(tmp_path):
    path = tmp_path / "octopi.txt"
    path.write_text("\n".join(line.partition("Recv:")[2] for line in marlin()))
    extruder = {"measurement": "extruder.temp"}
    with pytest.raises(Unusable, match=r"no channel is the time; .* or give --sampling"):
        read_loop_log(path, extruder)
    check(read_loop_log(path, extruder, 2.0), rate=2.0)
