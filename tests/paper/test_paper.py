"""The reproduced figures of the paper, and the page that shows them; by day one of them."""

import base64
import math
import re
import sys
from dataclasses import replace
from html.parser import HTMLParser
from xml.etree import ElementTree as ET

import numpy as np
import pytest

from estune.support.html_page import render
from experiments import paper
from experiments.paper.__main__ import main
from experiments.paper.page import page
from plants.models.reel import Reel


@pytest.fixture(scope="module")
def paper_figures(tmp_path_factory):
    """Figures and page of `python -m experiments.paper --quick`."""
    figures, original = [], paper.make

    def kept(number, *, quick):
        figures.append(original(number, quick=quick))
        return figures[-1]

    out = tmp_path_factory.mktemp("paper") / "paper.html"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(paper, "make", kept)
        patch.setattr(sys, "argv", ["paper", "--quick", "--out", str(out.parent)])
        assert main() == 0
    return {figure.number: figure for figure in figures}, out


class Page(HTMLParser):
    """Parser that collects the page's words, link targets and open elements."""

    def __init__(self, text):
        super().__init__()
        self.words, self.addresses, self.open, self.ids = [], [], [], set()
        self.feed(text)

    def handle_starttag(self, tag, attributes):
        values = dict(attributes)
        self.addresses += [values[name] for name in ("src", "href", "action") if name in values]
        self.ids |= {values["id"]} if "id" in values else set()
        if tag not in {"meta", "img", "link", "source"}:
            self.open.append(tag)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        self.words.append(data)


@pytest.mark.nightly
def test_page_has_every_figure_with_claim_and_verdict(paper_figures):
    figures, out = paper_figures
    assert set(figures) == set(paper.NUMBERS)
    page = Page(out.read_text())
    text = re.sub(r"\s+", " ", "".join(page.words)).replace("\N{MINUS SIGN}", "-")
    assert not page.open
    for figure in figures.values():
        assert f"Fig. {figure.number}. {figure.title}" in text
        for sentence in (figure.claim, figure.measured, figure.rule, figure.caveat):
            assert sentence in text
        assert f"figure-{figure.number}" in page.ids
    verdicts = re.findall(r"(Holds|Does not hold) here\.", text)
    assert verdicts == ["Holds" if f.holds else "Does not hold" for f in figures.values()]
    assert [p.name for p in out.parent.iterdir()] == [out.name]


@pytest.mark.nightly
def test_page_has_no_external_references(paper_figures):
    _, out = paper_figures
    text = out.read_text()
    page = Page(text)
    assert "://" not in text
    assert not re.search(r"@import|url\(|<script|<link", text)
    drawings = [a for a in page.addresses if not a.startswith("#")]
    assert len(drawings) == len(paper.NUMBERS)
    for address in drawings:
        kind, content = address.split(",", 1)
        assert kind == "data:image/svg+xml;base64"
        drawing = ET.fromstring(base64.b64decode(content))  # noqa: S314  our own drawing
        assert drawing.tag == "{http://www.w3.org/2000/svg}svg"
        for element in drawing.iter():
            links = [v for name, v in element.attrib.items() if name.endswith("href")]
            assert all(link.startswith("#") for link in links)
            assert element.tag.rpartition("}")[2] != "script"
    targets = {a[1:] for a in page.addresses if a.startswith("#")}
    assert targets == {f"figure-{number}" for number in paper.NUMBERS}


@pytest.mark.nightly
def test_figure_sentence_agrees_with_its_numbers(paper_figures):
    figures, _ = paper_figures
    for figure in figures.values():
        number = r"-?\d+(?:\.\d+)?(?:e[+-]?\d+)?"
        stated = [float(n) for n in re.findall(number, figure.measured)]
        for name, value in figure.numbers.items():
            near = min(abs(n / scale - value) for n in stated for scale in (1.0, 100.0, 1000.0))
            assert near <= 0.06 * abs(value) + 1e-9, (figure.number, name, value)


@pytest.mark.nightly
def test_bandwidth_figures_recover_the_reels_parameters(paper_figures):
    figures, _ = paper_figures
    for number, length in ((10, 0.5), (11, 1.4)):
        low, high = (Reel(length, T).natural_frequency_rad_s for T in (5.0, 40.0))
        numbers = figures[number].numbers
        ratio = numbers["resonance_high_Hz"] / numbers["resonance_low_Hz"]
        assert ratio == pytest.approx(high / low, rel=0.01)
    for name, length in (("damping_short", 0.5), ("damping_long", 1.4)):
        reel = Reel(length, 15.0)
        friction = 0.010 + 0.015 * length  # N m s/rad, the reference reel's
        damping = friction / (2.0 * reel.drum_inertia_kg_m2 * reel.natural_frequency_rad_s)
        assert figures[9].numbers[name] == pytest.approx(damping, rel=0.02)


@pytest.mark.nightly
def test_eyelet_figures_recover_the_benches_parameters(paper_figures):
    figures, _ = paper_figures

    def lost(coefficient, turn_rad):  # (22) as a quadratic equation
        bent = 1.0 + coefficient**2 * math.cos(math.pi - turn_rad)
        return 1.0 - min(np.roots([1.0, -2.0 * bent / (1.0 - coefficient**2), 1.0]))

    for name in ("B_low", "B_high"):
        built = 1.0 - lost(0.1, math.pi - 2.1)
        assert figures[7].numbers[name] == pytest.approx(built, abs=0.002)
    for turn in (15.0, 40.0, 60.0, 95.0):
        loss = figures[15].numbers[f"loss_at_{turn:g}_deg"]
        assert loss == pytest.approx(lost(0.1, math.radians(turn)), rel=0.05)


def test_failed_claim_is_shown_as_failed():
    figure = paper.make(18, quick=True)
    failed = replace(figure, holds=False, caveat="Because <a> & <b>.")
    text = render(page([figure, failed]))
    assert "1&nbsp;of 2&nbsp;claims hold here." in text
    assert '<span class="no">does not hold</span>' in text
    assert '<span class="no">Does not hold here.</span>' in text
    assert "Because &lt;a&gt; &amp; &lt;b&gt;." in text


@pytest.mark.slow
def test_page_is_reproducible():
    first, second = (render(page([paper.make(18, quick=True)])) for _ in range(2))
    assert first == second


def test_unwritable_page_is_refused_before_the_figures_are_made(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(paper, "make", lambda *_, **__: pytest.fail("worked in vain"))
    (tmp_path / "file").touch()
    monkeypatch.setattr(sys, "argv", ["paper", "--out", str(tmp_path / "file")])
    with pytest.raises(SystemExit):
        main()
    assert "--out" in capsys.readouterr().err
