"""A setting is declared once: options, keys, parameters, checks and pages follow from it."""

import inspect

import pytest

import estune
from estune.cli import run
from estune.cli.options import CostOptions, LimitOptions, SearchOptions, StepOptions
from estune.core.setting import declared
from estune.daemon.config import RigTable
from estune.errors import InvalidInput
from estune.hardware.tables import ControllerTable, RigStepTable
from estune.run.plan import Search
from estune.run.toml_tables import (
    CONTROLLER,
    COST,
    LIMITS,
    SEARCH,
    STEP,
    CostTable,
    SearchTable,
    StepTable,
)
from estune.studies.sweep.design import SweepDesign
from estune.support.toml_file import validate
from estune.trial.profiles import StepProfile
from tests import settings_page

TABLES = {StepTable: STEP, CostTable: COST, SearchTable: SEARCH, ControllerTable: CONTROLLER}
OPTIONS = {StepOptions: STEP, CostOptions: COST, SearchOptions: SEARCH, LimitOptions: LIMITS}


def _below(least):
    return None if least is None else least - 1


BOUNDED = [
    (table, member, wrong)
    for table, group in {**TABLES, SearchTable: LIMITS}.items()
    for member in group.members
    if member.kind in (int, float)
    for wrong in (
        *(member.setting.above, member.setting.below),
        *(_below(member.setting.least), float("nan")),
    )
    if wrong is not None
]


def names(group):
    return {member.name for member in group.members}


def test_every_setting_is_a_key_an_option_and_a_row_of_the_page():
    for table, group in TABLES.items():
        assert names(group) <= set(table.model_fields)
    assert names(LIMITS) | names(SEARCH) <= set(SweepDesign.model_fields)
    tuning = RigTable.model_fields["tuning"].annotation
    assert names(LIMITS) | names(SEARCH) <= set(tuning.model_fields)
    own = {member.name for member in declared(StepProfile)} - {"loop", "kind"}
    assert set(RigStepTable.model_fields) == own
    for options, group in OPTIONS.items():
        assert names(group) - {"bounds"} == set(inspect.signature(options).parameters)
    text = settings_page.PAGE.read_text("utf-8")
    assert settings_page.page(text) == text, "run: ./dev python -m tests.settings_page"


def test_parameters_of_tune_are_written_out_with_type_default_and_meaning():
    parameters = inspect.signature(estune.tune).parameters
    for member in declared(Search):
        assert parameters[member.name].default == member.default
        assert f"\n    {member.name}: {member.setting.help[:40]}" in inspect.getdoc(estune.tune)
    assert parameters["trials"].annotation is int
    assert next(iter(parameters)) == "target"
    assert all(p.kind is p.KEYWORD_ONLY for name, p in parameters.items() if name != "target")
    for wrong, remedy in (
        ("trails", "did you mean trials"),
        ("max_overshoot", r"give limits=RobustnessLimits\(max_overshoot=...\)"),
    ):
        with pytest.raises(TypeError, match=f"unexpected keyword argument '{wrong}'; {remedy}"):
            estune.tune("plants:reference_reel", **{wrong: 3})


@pytest.mark.parametrize(("table", "member", "wrong"), BOUNDED)
def test_value_outside_its_range_is_refused_by_name(table, member, wrong):
    with pytest.raises(InvalidInput, match=rf"^file: {member.name}\b"):
        validate(table, {member.name: wrong}, "file")


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--step-N", "nan"], "step_N: must be a finite number"),
        (["--max-sensitivity", "0.5"], "max_sensitivity is 0.5; it must be finite and above 1"),
        (["--tolerance", "150%"], "tolerance is 1.5; it must be finite and from 0 to below 1"),
        (["--tolerance", "much"], "--tolerance: 'much' is not a number"),
        (["--trials", "0"], "trials is 0; it must be finite and 1 or more"),
    ],
)
def test_option_outside_its_range_is_refused_by_name(words, message, capsys):
    assert run(["tune", "plants:reference_reel", *words]) == InvalidInput.exit_code
    assert message in " ".join(capsys.readouterr().err.split())


def test_share_may_be_in_per_cent_and_a_limit_none():
    table = validate(SearchTable, {"max_overshoot": "2%", "max_sensitivity": "none"}, "file")
    assert table.limits.max_overshoot == pytest.approx(0.02)
    assert table.limits.max_sensitivity is None
    assert validate(CostTable, {"rejection": 0.5}, "file").rejection == 0.5
    with pytest.raises(InvalidInput, match="max_overshoot"):
        validate(SearchTable, {"max_overshoot": "much"}, "file")


def test_declaration_as_json_is_enough_for_a_form():
    rows = {member.name: member.to_json() for member in (*STEP.members, *COST.members)}
    assert rows["duration_s"]["unit"] == "s"
    assert rows["duration_s"]["above"] == 0.0
    assert rows["weight"]["choices"] == ["printed", "rising"]
    assert all(row["help"] for row in rows.values())
