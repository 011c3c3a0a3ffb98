"""Report of a tuning: what it recommends, what it carries, and its colours."""

import base64
import re

import numpy as np
import pytest
from matplotlib.colors import to_rgb

from estune import load, tune
from estune.cli import run
from estune.run.results.report import page
from estune.support import page_image, plot_style
from estune.support.html_page import Drawing, render
from tests.support_runs import ArithmeticRig

QUICK = {"tuner": "safe_bayesian", "tolerance": 0.0, "journal": False, "watch": None}


@pytest.fixture(scope="module")
def tuned():
    return tune(ArithmeticRig(), trials=12, **QUICK)


@pytest.fixture(scope="module")
def unimproved():
    return tune(ArithmeticRig(gains=ArithmeticRig.best), trials=2, **QUICK)


def drawings(result):
    blocks = [b for section in page(result).sections for b in section.blocks]
    return {b.name: b for b in blocks if isinstance(b, Drawing)}


def test_report_of_an_improvement_recommends_the_gains_with_the_interval(tuned):
    made = page(tuned)
    assert made.headline.good is None  # its logged effort shows no limits
    assert made.headline.text.startswith("Tuned, limits not shown: no sensitivity is claimed")
    assert f"With {tuned.rig.gains_text(tuned.gains)}: rise " in made.headline.text
    assert "; the cost falls" in made.headline.text
    assert str(tuned.improvement) in made.headline.text


@pytest.mark.usefixtures("undrawn")
def test_report_without_improvement_keeps_the_gains_and_shows_no_second_column(unimproved):
    made = page(unimproved)
    assert made.headline.good is None
    assert (
        made.headline.text
        == f"No significant improvement: keep {unimproved.rig.gains_text(unimproved.start_gains)}."
    )
    assert "Tuned gains" not in render(made)


def test_csv_of_the_response_is_the_record(tuned):
    header, *rows = drawings(tuned)["response"].csv.splitlines()
    column = header.split(",").index("initial_measurement")
    values = [float(row.split(",")[column]) for row in rows]
    assert values == pytest.approx(tuned.first_record.tension_N, rel=1e-8)


def test_csv_of_the_search_has_a_row_for_each_trial(tuned):
    assert len(drawings(tuned)["search"].csv.splitlines()) == len(tuned.entries) + 1


def test_page_is_one_small_file_without_script_and_the_same_each_time(tuned):
    text = render(page(tuned))
    assert text == render(page(tuned))
    assert len(text) < 1_500_000
    assert "<script" not in text
    addresses = re.findall(r'(?:src|srcset|href)="([^"]*)"', text)
    assert all(address.startswith("data:") for address in addresses)


@pytest.mark.usefixtures("undrawn")
def test_run_without_a_trial_has_a_report(tmp_path):
    class Unreachable(ArithmeticRig):
        def run(self, _request):
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        tune(Unreachable(), run="none", folder=tmp_path, watch=None)
    text = render(page(load(tmp_path / "none")))
    assert "No trial has been completed." in text
    assert "Stopped: keep" in text


def contrast(one, other):
    """Contrast of two colours, 1 to 21, by the W3C's Web Content Accessibility Guidelines."""
    coded = np.array([to_rgb(one), to_rgb(other)])
    linear = np.where(coded <= 0.04045, coded / 12.92, ((coded + 0.055) / 1.055) ** 2.4)
    low, high = sorted(linear @ (0.2126, 0.7152, 0.0722) + 0.05)
    return high / low


@pytest.mark.parametrize("name", ["GREY", "BLUE", "VERMILION", "GREEN", "ORANGE", "PURPLE"])
def test_colours_of_lines_are_distinct_on_both_grounds(name):
    light = getattr(plot_style, name)
    dark = page_image.dark_colour(light)
    assert contrast(light, "#ffffff") >= 3.0
    assert contrast(dark, page_image.DARK_GROUND) >= 3.0


def test_every_colour_of_a_figure_has_a_dark_form(tuned):
    text = render(page(tuned))
    images = re.findall(r'<img src="data:image/svg\+xml;base64,([^"]*)"', text)
    for image in map(base64.b64decode, images):
        svg = image.decode()
        style, drawn = svg.split("</style>", 1)
        for key, colour in set(re.findall(r"(fill|stroke): (#[0-9a-f]{6})", drawn)):
            assert f'[style*="{key}: {colour}"]' in style


def test_legend_of_a_narrow_figure_fits():
    figure = plot_style.new_figure(plot_style.WIDTH_in, 3.0)
    ax = figure.add_subplot()
    for n in range(4):
        ax.plot([0.0, 1.0], [0.0, n], label=f"a curve with a long name {n}")
    plot_style.legend(ax)
    page_image.narrow(figure).draw_without_rendering()
    assert ax.get_legend().get_window_extent().x1 <= figure.bbox.x1


@pytest.mark.usefixtures("undrawn")
def test_command_writes_the_page_into_the_folder_of_the_run(tmp_path, capsys):
    tune(ArithmeticRig(), trials=2, run="one", folder=tmp_path, **{**QUICK, "journal": True})
    assert run(["report", str(tmp_path / "one")]) == 0
    assert str(tmp_path / "one" / "report.html") in capsys.readouterr().out
    assert (tmp_path / "one" / "report.html").read_text(encoding="utf-8").startswith("<!DOCTYPE")
    assert (
        run(["report", "one", "--folder", str(tmp_path), "--out", str(tmp_path / "no" / "x")]) == 2
    )
