"""Margins and gains from logs: what is used, what ran, what is known, what is recommended."""

import csv
import json
import math
from dataclasses import replace

import numpy as np
import pytest

import estune
import plants
from estune.cli import main
from estune.cli.stated_controller import stated_controller
from estune.cli.suggest import _show
from estune.core.controller_equation import unlimited_effort
from estune.core.controller_form import ControllerForm
from estune.core.gains import Gains
from estune.core.pidf import ControllerSettings
from estune.errors import InvalidInput
from estune.loop_model.optimum import RobustnessLimits
from estune.loop_model.prediction import predict
from estune.recordings.loop_log import LoopLog, read_loop_log
from estune.service_records.advice import advise
from estune.service_records.identification import ServicePart, identify
from estune.service_records.replay import replay
from estune.service_records.sources import Logs, read_logs
from estune.service_records.stretches import Stretch, find_stretches
from experiments.loop_claims.truth import TrueLoop, true_sensitivity
from experiments.sample_efficiency.problems import PROBLEMS
from experiments.service_records.service import Service, serve
from tests.support_lanes import first_by_day
from tests.support_runs import start_for

REEL = PROBLEMS["reel 1.4 m"]


@pytest.fixture(scope="module")
def busy():
    """A log of a reel in busy service at weak gains."""
    return log_of("busy")


def log_of(kind, seed=3):
    r = serve(REEL.plant, REEL.trial, REEL.start, Service(kind), seed)
    return r.log(REEL.trial.controller.sampling_Hz, REEL.start, kind)


def suggest(log, **options):
    trial = REEL.trial
    given = {"settling_time_s": trial.cost.settling_time_s, "step": trial.step.size}
    return estune.suggest(Logs((log,), (), trial.controller), **given | options)


@pytest.fixture(scope="module")
def suggested(busy):
    """What is said of it."""
    return suggest(busy)


def write(path, part):
    with path.open("w", newline="") as file:
        rows = csv.writer(file)
        rows.writerow(["time_s", "setpoint", "measured", "output"])
        rows.writerows(zip(*part.values(), strict=True))


def test_margins_of_a_busy_log_hold_the_true_ones(suggested):
    Ms = suggested.margins.sensitivity
    true = true_sensitivity(REEL.plant, REEL.start)
    assert Ms.low <= true <= Ms.high
    assert Ms.high / Ms.low < 1.3


def test_a_stretch_much_shorter_than_the_settling_time_does_no_harm(busy):
    (part,) = busy.parts
    parts = tuple(
        {n: v[rows] for n, v in part.items()} for rows in (slice(0, 34), slice(40, None))
    )
    Ms = suggest(busy._replace(parts=parts)).margins.sensitivity
    assert Ms.low <= true_sensitivity(REEL.plant, REEL.start) <= Ms.high


def test_recommended_gains_are_better_and_keep_the_limits(suggested):
    assert suggested.verdict == "change"
    true = TrueLoop(REEL.plant, REEL.cost)
    at, now = true.at(suggested.recommendation.gains), true.at(REEL.start)
    assert at.cost < 0.7 * now.cost
    assert true_sensitivity(REEL.plant, suggested.recommendation.gains) <= 1.65
    assert at.overshoot <= 0.06


def test_the_effort_need_not_be_logged(busy, suggested):
    (part,) = busy.parts
    without = {name: values for name, values in part.items() if name != "effort"}
    one = suggested.margins.sensitivity.value
    other = suggest(busy._replace(parts=(without,))).margins.sensitivity.value
    assert other == pytest.approx(one, rel=0.01)


@pytest.mark.slow
def test_a_loop_that_holds_still_tells_nothing_and_the_experiment_advised_tells():
    still = suggest(log_of("still"))
    assert still.exit_code == 9
    assert still.margins is None
    assert still.recommendation is None
    wanted = still.experiment
    plant, settings = REEL.plant, REEL.trial.controller
    random = np.random.default_rng(5)
    samples = wanted.trial.profile.samples(settings.sampling_Hz)
    noise = plant.noise_rms_N * random.standard_normal(samples)
    r = plants.simulate(plant, REEL.start, wanted.trial.profile, noise_N=noise)
    part = {
        "time": r.time_s,
        "setpoint": r.setpoint_N,
        "measurement": r.tension_N,
        "effort": r.effort_N,
    }
    log = LoopLog("multisine", settings.sampling_Hz, (part,), REEL.start, {}, {}, ())
    Ms = suggest(log).margins.sensitivity
    true = true_sensitivity(plant, REEL.start)
    assert Ms.low <= true <= Ms.high


def test_gains_that_did_not_run_are_the_first_line(busy, capsys):
    wrong = Gains(*(1.5 * g for g in REEL.start.as_tuple()[:3]), REEL.start.setpoint_filter_s)
    found = suggest(busy, gains=wrong)
    assert found.exit_code == 10
    calm = replace(found, cause=replace(found.cause, name="none"))
    _show(calm, None, None)
    assert capsys.readouterr().out.startswith("OTHER GAINS RAN")
    assert found.in_use.as_tuple() == pytest.approx(REEL.start.as_tuple(), rel=1e-3)
    in_other_form = found.replay._replace(ran=wrong)
    assert replace(found, replay=in_other_form).heading().startswith("OTHER FORM RAN")


def part_of(log, rows, name, **columns):
    (part,) = log.parts
    kept = {channel: values[:rows] for channel, values in (part | columns).items()}
    return log._replace(name=name, parts=(kept,))


def test_gains_misstated_in_an_earlier_log_and_one_that_no_gains_explain_leave_the_verdict(busy):
    noise = np.random.default_rng(1).standard_normal(busy.parts[0]["effort"].size)
    logs = (
        part_of(busy, 4000, "misstated.csv"),
        part_of(busy, 4000, "strange.csv", effort=noise),
        part_of(busy, 6000, "last.csv"),
    )
    trial = REEL.trial
    found = estune.suggest(
        Logs(logs, (), trial.controller),
        gains={"misstated": replace(REEL.start, P=2.0 * REEL.start.P)},
        settling_time_s=trial.cost.settling_time_s,
        step=trial.step.size,
    )
    assert found.verdict != "other gains ran"
    assert found.ran_otherwise == ("misstated.csv",)
    ran, true = found.gains_by_log["misstated.csv"].P, REEL.start.P
    assert ran == pytest.approx(true, rel=1e-3)
    assert any("misstated.csv" in remark for remark in found.remarks())
    assert [part.log for part in found.left_out] == ["strange.csv"]


def test_stretches_at_a_limit_and_in_manual_are_left_out(busy):
    (part,) = busy.parts
    limited = part["effort"].copy()
    top = np.quantile(limited, 0.97)
    limited = np.minimum(limited, top)
    limited[1000:1200] = limited[1000]
    log = busy._replace(parts=({**part, "effort": limited},))
    unstated, _ = find_stretches(log, None)
    assert all((s.effort < top).all() for s in unstated)
    stretches, left_out = find_stretches(log, REEL.start.P)
    reasons = {one.reason for one in left_out}
    assert any("upper limit" in reason for reason in reasons)
    assert any("another mode" in reason for reason in reasons)
    assert all((s.effort < top).all() for s in stretches)


@pytest.mark.parametrize(
    "form",
    [
        ControllerForm(integral="backward"),
        ControllerForm(derivative_on="error"),
    ],
)
def test_replay_finds_the_form_that_ran(form):
    random = np.random.default_rng(2)
    setpoint = np.repeat(random.standard_normal(20), 100)
    measured = np.convolve(setpoint, np.full(40, 1 / 40))[: setpoint.size]
    measured = measured + 0.01 * random.standard_normal(setpoint.size)
    own = ControllerSettings(100.0, 0.02, -math.inf, math.inf)
    gains = Gains(2.0, 20.0, 0.1, 0.05)
    ran = replace(own, form=form)
    effort = unlimited_effort(ran, gains, setpoint, measured, first_effort=3.0)
    stretch = Stretch("log", 0.0, setpoint, measured, effort)
    assert replay([stretch], ran, gains).agrees
    found = replay([stretch], own, gains)
    assert not found.agrees
    assert found.ran == gains
    assert found.controller.form == form


def test_terms_that_rounded_signals_alone_would_need_are_not_said_to_have_run():
    setpoint = np.repeat(np.random.default_rng(2).uniform(-1.0, 1.0, 20), 100)
    measured = np.round(np.convolve(setpoint, np.full(40, 1 / 40))[: setpoint.size], 3)
    own = ControllerSettings(100.0, 0.02, -math.inf, math.inf)
    effort = np.round(16.0 * (setpoint - measured), 5)
    ran = replay([Stretch("log", 0.0, setpoint, measured, effort)], own, None).ran
    assert (ran.I, ran.D, ran.setpoint_filter_s) == (0.0, 0.0, 0.0)
    assert pytest.approx(16.0, rel=1e-5) == ran.P


def test_a_step_beyond_the_motion_of_the_records_is_said(suggested):
    for size, is_said in ((1e-3, False), (1e3, True)):
        trial = replace(suggested.trial, step=suggested.trial.step._replace(size=size))
        remarks = replace(suggested, trial=trial).remarks()
        assert any("larger than the setpoint's range" in one for one in remarks) == is_said


def test_logs_of_a_folder_are_in_the_order_of_their_numbers(tmp_path):
    for number in (10, 2, 9):
        write(tmp_path / f"run{number}.csv", dict.fromkeys("tsyu", range(number, number + 50)))
    assert [log.name for log in read_logs(tmp_path).logs] == ["run2.csv", "run9.csv", "run10.csv"]


def test_gains_of_logs_are_read_from_a_file_and_those_of_no_log_refused(tmp_path):
    file = tmp_path / "gains.toml"
    file.write_text('[gains]\n"one.csv" = { P = 2.0, I = 0.5 }\ntwo = { P = 3.0 }\n')
    stated = stated_controller(str(file)).gains
    assert stated == {"one.csv": Gains(2.0, 0.5, 0.0, 0.0), "two": Gains(3.0, 0.0, 0.0, 0.0)}
    for name in ("one", "too"):
        write(tmp_path / f"{name}.csv", dict.fromkeys("tsyu", range(50)))
    with pytest.raises(InvalidInput, match="given for two, but the logs are one"):
        estune.suggest([tmp_path / "one.csv", tmp_path / "too.csv"], gains=stated)
    rig = "driver = {}\n[gains]\nP = 1.0\n[controller]\nderivative_filter_s = 0.01\n"
    file.write_text(rig)
    assert stated_controller(str(file)) == (Gains(1.0, 0.0, 0.0, 0.0), 0.01)
    file.write_text("[gains]\nP = -1.0\n")
    with pytest.raises(InvalidInput, match="gains: P: must be greater than 0"):
        stated_controller(str(file))


@pytest.mark.usefixtures("undrawn")
def test_command_reads_a_csv_and_writes_report_and_json(busy, tmp_path, capsys):
    write(tmp_path / "log.csv", busy.parts[0])
    P, I, D, F = REEL.start.as_tuple()
    given = [
        *("suggest", str(tmp_path / "log.csv"), "--gains", f"P={P},I={I},D={D},F={F}"),
        *("--map", "measurement=measured", "--derivative-filter"),
        *(str(REEL.trial.controller.derivative_filter_s), "--settling", "0.2"),
        *("--report", str(tmp_path / "page.html"), "--json"),
    ]
    with pytest.raises(SystemExit) as ended:
        main(given)
    assert ended.value.code == 0
    said = capsys.readouterr()
    assert "identifying the loop" in said.err
    assert "done" in said.err
    found = json.loads(said.out)
    assert found["verdict"] == "change"
    assert found["replay"]["agrees"]
    page = (tmp_path / "page.html").read_text()
    assert "Nyquist" in page
    cause, verdict = (text.partition(":")[0] for text in (found["cause"]["heading"], "CHANGE:"))
    assert page.index(cause) < page.index(verdict)
    assert "1 samples" not in page


@pytest.mark.parametrize(
    ("heading", "message"),
    [
        ("time_s,wanted,measured,output", "no channel is the setpoint"),
        ("time_s,setpoint_N,measurement_A,output", "same quantity"),
        (
            "when,setpoint,measurement,output",
            "no channel is the time; .* when: name it, as in --map time=when; or give --sampling",
        ),
    ],
)
def test_a_log_whose_columns_are_not_clear_is_refused_with_the_remedy(tmp_path, heading, message):
    path = tmp_path / "log.csv"
    path.write_text(heading + "\n" + "\n".join(f"{k},0,0,{k}" for k in range(50)))
    with pytest.raises(InvalidInput, match=message):
        estune.suggest(path, gains=Gains(1.0, 0.0, 0.0, 0.0))


def test_records_lists_the_stretches_and_why_some_show_nothing(tmp_path, capsys):
    setpoint = np.concatenate([np.zeros(200), np.repeat([1.0, -1.0, 0.5], 100), np.zeros(100)])
    measured = np.convolve(setpoint, np.full(20, 0.05))[: setpoint.size]
    measured += 0.01 * np.random.default_rng(1).standard_normal(setpoint.size)
    effort = 2.0 * (setpoint - measured)
    effort[400:450] = 1.25  # by hand
    time = np.arange(setpoint.size) * 0.1
    write(tmp_path / "log.csv", {"t": time, "r": setpoint, "y": measured, "u": effort})
    with pytest.raises(SystemExit):
        main(["records", str(tmp_path / "log.csv"), "--json"])
    rows = json.loads(capsys.readouterr().out)["service"]
    (by_hand,) = [row for row in rows if "another mode" in row["reason"]]
    assert by_hand["start_s"] == pytest.approx(40.0)
    assert by_hand["stop_s"] == pytest.approx(44.9)
    assert not rows[0]["reason"]
    with pytest.raises(SystemExit):
        main(["records", str(tmp_path / "log.csv")])
    assert "usable" in capsys.readouterr().out


def test_unknown_gains_are_refused_where_no_effort_shows_them(busy):
    (part,) = busy.parts
    without = {name: values for name, values in part.items() if name != "effort"}
    with pytest.raises(InvalidInput, match="gains that ran"):
        suggest(busy._replace(parts=(without,), gains=None))


def test_a_tuning_from_logs_starts_within_its_limits_near_the_optimum(busy, tmp_path):
    write(tmp_path / "log.csv", busy.parts[0])
    (tmp_path / "log.csv").write_text((tmp_path / "log.csv").read_text().replace("measured", "y"))
    known = start_for(f"records:{tmp_path}", REEL.plant.describe("reel", REEL.start))
    assert true_sensitivity(REEL.plant, known.gains) <= 1.65
    result = estune.tune(
        REEL.plant, start=known, limits=RobustnessLimits(), journal=False, watch=None, trials=8
    )
    assert result.plan.start_source.startswith("the gains recommended by the logs")
    assert result.verdict.start_cost <= 1.1 * result.verdict.cost


@pytest.mark.parametrize("cost", first_by_day("rejection", "itae"))
def test_suggestion_minimises_the_cost_it_is_given(busy, suggested, cost):
    found = suggest(busy, cost=cost)
    trial, loop = found.trial, found.fit
    costs = [
        predict(loop.model, trial, one.recommendation.gains, loop.noise_std).cost
        for one in (found, suggested)
    ]
    assert costs[0] < costs[1]


def test_gains_that_none_were_stated_against_follow_from_the_effort(busy):
    found = suggest(busy._replace(gains=None))
    assert found.exit_code == 0
    assert pytest.approx(REEL.start.P, rel=1e-3) == found.in_use.P
    assert found.remarks()[0].startswith("The gains that ran follow from the logged effort")


@pytest.mark.slow
def test_a_tuning_from_logs_of_earlier_gains_reads_them_from_the_effort(busy, tmp_path):
    write(tmp_path / "log.csv", busy.parts[0])
    live = replace(REEL.start, P=1.3 * REEL.start.P)
    known = start_for(f"records:{tmp_path}", REEL.plant.describe("reel", live))
    assert true_sensitivity(REEL.plant, known.gains) <= 1.65


def test_a_tuning_from_logs_keeps_the_cost_and_the_limits_of_its_run(busy, tmp_path):
    write(tmp_path / "log.csv", busy.parts[0])
    rig = REEL.plant.describe("reel", REEL.start)
    rule, limits = estune.start_from(f"records:{tmp_path}"), RobustnessLimits(1.4)
    known = rule(rig, REEL.trial, limits)
    assert true_sensitivity(REEL.plant, known.gains) <= 1.45
    gentle = replace(REEL.trial, cost=replace(REEL.trial.cost, move_weight=20.0))
    assert rule(rig, gentle, limits).gains.P < known.gains.P


def test_advised_experiment_is_as_long_as_the_wanted_interval_needs(suggested):
    loop = identify(
        [ServicePart(s, REEL.start) for s in suggested.stretches], REEL.trial.controller, None
    )
    rough, fine = (advise(loop, suggested.trial, REEL.start, aim) for aim in (0.1, 0.05))
    assert fine.share > rough.share or fine.duration_s > 3.0 * rough.duration_s


@pytest.mark.parametrize(
    "header",
    [
        ("Time [s]", "SP (°C)", "PV (°C)", "OP %"),
        ("t", "Setpoint [1/min]", "Speed [1/min]", "Controller output (%)"),
        ("Timestamp", "loop1.SP", "loop1.PV", "loop1.OUT"),
    ],
)
def test_columns_are_found_by_names_with_units_in_brackets(tmp_path, header):
    rows = [",".join(header), *(f"{0.1 * k},{k % 7},{k % 5},{k % 3}" for k in range(40))]
    (tmp_path / "log.csv").write_text("\n".join(rows))
    found = read_loop_log(tmp_path / "log.csv")
    assert set(found.sources) == {"time", "setpoint", "measurement", "effort"}
    assert found.sampling_Hz == pytest.approx(10.0)


def test_rows_of_a_log_without_a_measurement_are_a_gap(tmp_path):
    rows = [f"{k},1,{'' if 20 <= k < 24 else k % 5},{k % 3}" for k in range(60)]
    (tmp_path / "log.csv").write_text("\n".join(["time_s,setpoint,measurement,output", *rows]))
    found = read_loop_log(tmp_path / "log.csv")
    assert [part["time"].tolist() for part in found.parts] == [
        list(range(20)),
        list(range(24, 60)),
    ]
    assert "4 rows lack a value" in str(found.issues[0])


def test_replay_names_the_unit_of_time_where_times_are_a_thousand_times_too_long():
    random = np.random.default_rng(2)
    setpoint = np.repeat(random.standard_normal(20), 100)
    measured = np.convolve(setpoint, np.full(40, 1 / 40))[: setpoint.size]
    gains, ran = Gains(2.0, 20.0, 0.0, 0.0), ControllerSettings(100.0, 0.0, -math.inf, math.inf)
    effort = unlimited_effort(ran, gains, setpoint, measured, first_effort=3.0)
    stretch = Stretch("log", 0.0, setpoint, measured, effort)
    as_read = replace(ran, sampling_Hz=0.1)
    assert "check the unit of the time" in replay([stretch], as_read, gains).sentence()
    assert "unit of the time" not in replay([stretch], ran, replace(gains, I=30.0)).sentence()


def test_a_log_whose_effort_is_not_found_says_what_was_not_read(tmp_path):
    rows = [
        "time_s,setpoint,measurement,furnace",
        *(f"{k},{k % 7},{k % 5},{k}" for k in range(40)),
    ]
    (tmp_path / "log.csv").write_text("\n".join(rows))
    (issue,) = read_loop_log(tmp_path / "log.csv").issues
    assert "not read: furnace;" in str(issue)
    named = read_loop_log(tmp_path / "log.csv", {"effort": "furnace"})
    assert not named.issues


def test_logs_that_show_nothing_start_no_tuning(tmp_path):
    write(tmp_path / "log.csv", log_of("still").parts[0] | {})
    (tmp_path / "log.csv").write_text((tmp_path / "log.csv").read_text().replace("measured", "y"))
    with pytest.raises(InvalidInput, match="recommends no gains"):
        start_for(f"records:{tmp_path}", REEL.plant.describe("reel", REEL.start))
