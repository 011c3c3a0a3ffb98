"""Report pages: escaping, markup, and no reference to anything outside."""

import base64
import re

from estune.support.html_page import (
    Drawing,
    Link,
    Page,
    Paragraph,
    Section,
    Status,
    Table,
    Warnings,
    render,
)
from estune.support.plot_style import new_figure

HOSTILE = "<script>&</script>"


def drawing(csv: str = "") -> Drawing:
    figure = new_figure(2.0, 1.0)
    figure.add_subplot().plot([1.0, 2.0])
    return Drawing(figure, "line", 'a "line"', csv=csv)


def body(*sections: Section, summary=()) -> str:
    page = Page("Title", Status("2 of 3 pass", good=False), summary, sections)
    return render(page).split("</style>")[1]


def test_page_escapes_every_text():
    blocks = (
        Paragraph(HOSTILE),
        Paragraph(HOSTILE, style="code"),
        Status(HOSTILE, good=True, detail=HOSTILE),
        Table((HOSTILE,), ((HOSTILE,), (Status(HOSTILE, detail=HOSTILE),), (Link(HOSTILE, "x"),))),
        Warnings((HOSTILE,)),
    )
    text = body(Section(HOSTILE, blocks), summary=blocks)
    assert "<script" not in text
    assert text.count("&lt;script&gt;") == 21


def test_code_bold_minus_and_units_are_set():
    text = body(Section("S", (Paragraph("**Note** `x**2` is -3 N, not 2**3 or 4**5"),)))
    assert "<b>Note</b> <code>x**2</code> is &minus;3&nbsp;N, not 2**3&nbsp;or 4**5" in text


def test_a_long_first_cell_may_break_and_does_not_cover_the_next():
    text = body(Section("S", (Table(("effect", "why"), (("gain", "a"), ("gain, " * 20, "b"))),)))
    assert '<td class="short">gain</td>' in text
    assert "<td>gain, gain" in text


def test_page_is_self_contained_and_includes_its_data():
    text = body(Section("S", (drawing(csv="a,b\n1,2\n"),)))
    addresses = re.findall(r'(?:src|href)="([^"]*)"', text)
    assert [address.partition(",")[0] for address in addresses] == [
        "data:image/svg+xml;base64",
        "data:text/csv;base64",
    ]
    assert base64.b64decode(addresses[1].partition(",")[2]) == b"a,b\n1,2\n"
    assert 'alt="a &#34;line&#34;"' in text


def test_empty_sections_and_warnings_are_omitted():
    text = body(Section("Empty", ()), Section("Full", (Warnings(()), Paragraph("text"))))
    assert "Empty" not in text
    assert "<aside>" not in text
    assert "Full" in text
