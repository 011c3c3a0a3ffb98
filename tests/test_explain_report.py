"""What is shown of a diagnosis: page, figures, text, JSON."""

import base64
import json
import math
import re
from dataclasses import replace
from html.parser import HTMLParser
from xml.etree import ElementTree as ET

import control
import numpy as np
import pytest

import plants
from estune.errors import InvalidInput
from estune.support.html_page import render
from estune.support.plot_style import new_figure, to_png
from plants.diagnosis.interval import Interval
from plants.diagnosis.report import figures, summary
from plants.diagnosis.report.json_form import to_json
from plants.diagnosis.report.page import page
from plants.diagnosis.result import DeclaredEffect, ModelErrors, NamedEffect
from plants.effects import EFFECTS, CoulombFriction, Effect, Port, parameter, plant_scale
from tests.support_diagnosis import FOUND, NO_BLOCKS, deciding, diagnosis, nothing_found


class Page(HTMLParser):
    """The page's words, its tables, the addresses it refers to, and its open elements."""

    def __init__(self, text):
        super().__init__()
        self.words, self.cells, self.addresses, self.open = [], [], [], []
        self.feed(text)
        self.text = re.sub(r"\s+", " ", "".join(self.words)).replace("\N{MINUS SIGN}", "-")

    def handle_starttag(self, tag, attributes):
        found = dict(attributes)
        self.addresses += [found[name] for name in ("src", "href", "action") if name in found]
        if tag not in {"meta", "img", "link", "source"}:
            self.open.append(tag)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        self.words.append(data)
        if self.open and self.open[-1] == "td":
            self.cells.append(data.replace("\N{NO-BREAK SPACE}", " "))


@pytest.fixture(scope="module")
def named():
    return diagnosis()


@pytest.fixture(scope="module")
def shown(named):
    text = render(page(replace(named, where=NO_BLOCKS)))
    return text, Page(text)


@pytest.mark.usefixtures("undrawn")
def test_page_contains_all_of_the_diagnosis(named):
    found = Page(render(page(named)))
    assert not found.open
    for sentence in (
        named.heading(),
        named.sentence,
        named.effects[0].sentence,
        named.effects[0].effect.appearance,
        *(finding.sentence for finding in named.findings),
        *named.not_excited.values(),
    ):
        assert sentence.replace("\N{NO-BREAK SPACE}", " ") in found.text, sentence
    assert named.unexplained.sentence[1:] in found.text
    for name in (*named.not_excited, *(c.name for c in named.candidates), "attenuation"):
        assert name in found.cells
    for value in ("0.58 N", "0.047 N", "0.043 N", "0.91 N", "99.7 %", "0.9279 to 0.9341"):
        assert value in found.cells
    for title in (block.title for block in named.where.blocks):
        assert title[1:] in found.text


def test_page_needs_no_network_and_no_other_file(shown):
    text, found = shown
    assert "://" not in text
    assert not re.search(r"@import|url\(|<script|<link", text)
    assert len(found.addresses) >= 4
    for address in found.addresses:
        kind, content = address.split(",", 1)
        assert kind == "data:image/svg+xml;base64"
        drawing = ET.fromstring(base64.b64decode(content))  # noqa: S314  our own drawing
        for element in drawing.iter():
            links = [v for name, v in element.attrib.items() if name.endswith("href")]
            assert all(link.startswith("#") for link in links)


def test_page_is_reproducible(named, shown):
    assert render(page(replace(named, where=NO_BLOCKS))) == shown[0]


@pytest.mark.usefixtures("undrawn")
def test_page_escapes_user_text(named):
    hostile = '<script>alert("&")</script>'
    text = render(page(replace(named, sentence=hostile, where=NO_BLOCKS)))
    assert "<script>" not in text
    assert hostile in Page(text).text


@pytest.mark.usefixtures("undrawn")
@pytest.mark.parametrize(
    "made",
    [
        nothing_found(where=NO_BLOCKS),
        nothing_found(
            candidates=(),
            calibrations=(),
            not_excited={},
            findings=(),
            where=NO_BLOCKS,
        ),
        diagnosis(verdict="unknown", effects=(), where=NO_BLOCKS),
        diagnosis(
            verdict="ambiguous",
            ambiguous=("coulomb_friction", "dahl_hysteresis"),
            traces=(),
            where=NO_BLOCKS,
            next_experiment=deciding(),
        ),
    ],
    ids=["none", "bare", "unknown", "ambiguous"],
)
def test_every_verdict_has_page_json_and_text(made):
    found = Page(render(page(made)))
    assert not found.open
    assert made.sentence in found.text
    json.dumps(made.to_json(), allow_nan=False)
    assert made.heading() in repr(made)
    assert made._repr_html_().count("<svg") == 1
    assert "with the effects" in found.text or not made.effects
    if made.next_experiment is not None:
        assert made.next_experiment.command in found.text
        assert made.next_experiment.sentence[1:] in found.text
        assert made.to_json()["next_experiment"]["profile"]["kind"] == "triangle"


def test_json_has_public_keys_and_finite_numbers(named):
    told = json.loads(json.dumps(named.to_json(), allow_nan=False))
    assert {
        *("verdict", "effects", "candidates", "where", "not_excited", "next_experiment"),
        *("gap_before_N", "gap_after_N", "floor_N", "gap_before_floors", "gap_after_floors"),
    } <= set(told)
    assert told["verdict"] == "named"
    assert (told["gap_before_N"], told["gap_after_N"], told["floor_N"]) == (0.58, 0.047, 0.043)
    (effect,) = told["effects"]
    assert effect["name"] == "eyelet_friction"
    assert effect["parameters"]["inner_share"] == {
        "value": 0.21,
        "low": pytest.approx(0.19),
        "high": pytest.approx(0.23),
        "unit": "",
    }
    assert [c["name"] for c in told["candidates"]][:2] == ["eyelet_friction", "coulomb_friction"]
    assert told["candidates"][-1]["closure"] is None
    assert {"block", "regime", "band"} <= set(told["where"])


def test_json_of_an_angle_is_in_radians(named):
    told = replace(named, unit="rad").to_json()
    assert told["gap_before_rad"] == 0.58
    assert not [name for name in told if name.endswith("_N")]


def test_json_of_an_infinite_number_is_null():
    told = diagnosis(after=ModelErrors(math.inf, 1.2, math.nan)).to_json()
    assert told["gap_after_N"] is None
    assert told["free_run_after_N"] is None


def test_plots_use_given_axes_without_pyplot(named):
    import sys  # noqa: PLC0415  its only use

    before = "matplotlib.pyplot" in sys.modules
    for name in ("gap", "traces", "where", "ranking"):
        ax = new_figure(4.0, 3.0).add_subplot()
        assert getattr(named, f"plot_{name}")(ax=ax) is ax
        assert ax.has_data()
        assert to_png(ax.figure).startswith(b"\x89PNG")
    assert ("matplotlib.pyplot" in sys.modules) == before


def test_plot_of_an_unknown_record_is_refused(named):
    assert named.plot_traces("step-9").lines[0].get_xdata()[-1] < 1.0
    with pytest.raises(InvalidInput, match="no record multisine-2; there are triangle-3, step-9"):
        named.plot_traces("multisine-2")


def test_figures_show_their_numbers(named):
    gap = named.plot_gap()
    assert [bar.get_height() for bar in gap.patches] == [0.58, 0.047]
    trace = summary.worst_trace(named)
    assert trace.name == "triangle-3"
    frequency, density = figures.error_density([trace], "before")
    power = np.sum(density[1:] ** 2) * frequency[1]
    error = trace.measured - trace.before
    assert power == pytest.approx(np.var(error), rel=0.3)
    shares = named.plot_where()
    assert max(bar.get_width() for bar in shares.patches) == pytest.approx(72.0)


def test_excerpt_has_the_greatest_error():
    trace = summary.worst_trace(diagnosis())
    wrong = np.zeros(trace.time_s.size)
    wrong[200:500] = 1.0
    part = figures.excerpt(replace(trace, before=trace.measured - wrong))
    assert part.start <= 200
    assert part.stop >= 500


@pytest.mark.usefixtures("undrawn")
def test_unwritable_page_is_reported(tmp_path):
    named = diagnosis(where=NO_BLOCKS)
    with pytest.raises(InvalidInput, match="give another file"):
        named.report(tmp_path / "no" / "page.html")
    assert named.report(tmp_path / "page.html").read_text().startswith("<!DOCTYPE html>")


def test_saved_model_is_the_augmented_one(named, tmp_path):
    named.save(tmp_path / "improved.toml")
    assert plants.load_model(tmp_path / "improved.toml") == named.augmented
    assert named.heading() in (tmp_path / "improved.toml").read_text()


SHAPES = {"phase_rad", "damping", "density_kg_m", "spread", "bend", "knee"}
"""Parameters that a sentence may leave out."""


@pytest.mark.parametrize("name", sorted(EFFECTS))
def test_effect_sentence_holds_its_fitted_numbers(name):
    effect, reel = EFFECTS[name], plants.reference_reel()
    usual = effect()
    for share in (0.5, 1.0):
        values = {n: share * getattr(usual, n) for n in effect.parameters()}
        first, second = (
            effect.sentence(values, model)
            for model in (reel, plants.linear_plant(control.tf([1.0], [1.0, 1.0])))
        )
        assert first.startswith("Your reel ")
        assert second.startswith("Your plant ")
        for text in (first, second):
            assert text.endswith(".")
            assert not re.search(r"\bnan\b", text)
            assert len(text) < 300
        said = [float(n) for n in re.findall(r"(?<![\w.])\d+(?:\.\d+)?(?:e-?\d+)?", first)]
        for parameter_name, value in values.items():
            if value == 0.0 or parameter_name in SHAPES:
                continue
            scales = 10.0 ** np.arange(-6, 7)
            near = min(abs(n * scale - abs(value)) for n in said for scale in scales)
            assert near <= 0.006 * abs(value), (parameter_name, first)


def test_eyelet_friction_sentence_gives_the_ratio_of_tensions():
    said = EFFECTS["eyelet_friction"].sentence(FOUND, plants.reference_reel())
    assert said.startswith(
        "Your reel has eyelet friction: outside tension is 0.931 of inside when winding in"
    )
    # 6.9 % of 15 N
    assert "(1.03 N less at 15 N)" in said


def test_sentence_of_a_user_effect_has_title_numbers_and_appearance():
    from dataclasses import dataclass  # noqa: PLC0415  its only use

    @dataclass(frozen=True)
    class Heating(Effect):
        name = "motor_heating"
        title = "a motor that weakens as it warms up"
        appearance = "less tension for the same current, the more the longer"
        port = Port.ACTUATOR
        rate_per_s: float = parameter(1e-3, low=0.0, high=1.0, unit="1/s", neutral=0.0)

    said = Heating.sentence({"rate_per_s": 2.5e-3}, plants.reference_reel())
    assert said == (
        "Your reel has a motor that weakens as it warms up: rate_per_s 0.0025 1/s. "
        "In the data: less tension for the same current, the more the longer."
    )


@pytest.mark.parametrize(
    ("value", "unit", "said"),
    [
        (4.2e-4, "m", "420 µm"),
        (0.8, "m", "0.8 m"),
        (0.02, "N m", "0.02 N m"),
        (1.58e-3, "s", "1.58 ms"),
        (1000.0, "N/s", "1000 N/s"),
        (0.0, "N", "0 N"),
        (9.999e-4, "m", "1 mm"),
        (12345.0, "N", "12.3 kN"),
    ],
)
def test_si_chooses_a_readable_prefix(value, unit, said):
    assert plant_scale.si(value, unit) == said


def test_numbers_of_effects_are_named_in_the_plants_units_and_not_beyond_their_intervals(named):
    wide = Interval(0.0026, 0.0001, 0.0051, "m/s")
    effect = CoulombFriction(20.0, 0.0026)
    fitted = {"torque_Nm": Interval(20.0, 19.0, 21.0, "N"), "creep_rad_s": wide}
    shown = NamedEffect(effect.name, effect.title, fitted, "", effect)
    d = replace(named, effects=(shown,), base_model=plants.stage(95.0, 200.0))
    (_, force, value, *_), (_, creep, unknown, *_) = summary.parameters(d).rows
    assert (force, value, creep, unknown) == ("force_N", "20.0", "creep_m_s", "not determined")
    kept = {"supported": True, "explained": 0.9, "sentence": ""}
    declared = DeclaredEffect(effect.name, effect.title, fitted, **kept)
    told = to_json(replace(d, declared=(declared,), model=d.base_model + effect))
    for (shown_as,) in (told["effects"], told["declared"]):
        assert list(shown_as["parameters"]) == ["force_N", "creep_m_s"]


def test_tables_round_to_the_digits_of_the_interval(named):
    assert summary.parameters(named).rows == (
        ("eyelet_friction", "attenuation", "0.9310", "0.9279 to 0.9341", ""),
        ("eyelet_friction", "inner_share", "0.210", "0.190 to 0.230", ""),
    )
