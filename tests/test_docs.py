"""The documentation: the site built by Sphinx, the installed pages, their links and commands."""

import importlib.util
import re
import subprocess
import sys
from pathlib import Path

import pytest
from cyclopts import CycloptsError

from estune.cli import run
from estune.support.documentation import documentation_folder, documentation_pages, write_html
from tests.page_words import PAGE_MAX, TOTAL_MAX, page_words
from tests.support_browser import needs_browser, opened, serious
from tests.support_snippets import NAMED_FILE, check_commands

ROOT = Path(__file__).parents[1]
DOCS = ROOT / "docs"
PAGES = documentation_pages(DOCS)
NARROW_DARK = {"viewport": {"width": 400, "height": 800}, "color_scheme": "dark"}
WIDE = {"viewport": {"width": 1200, "height": 900}}
SUFFIXES = "toml|json|csv|html|mat|parquet|mcap|c|h|py|ledger|fmu|yaml|png|pem|key|csr|ext|dbc"
FILE = re.compile(rf"(?<![\w/.:*-])(?:[\w-]+/)*[\w.-]+\.(?:{SUFFIXES})\b")
WRITES = re.compile(
    r"(?:>|--(?:save|out|report|save-map|save-model)|-keyout|-out)[ =]+(\S+)"
    r"|Path\(\"([\w.]+)\"\)\.write"
)
EXAMPLE = re.compile(r"--example.*> (\S+)")


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    """The site, built with warnings as errors."""
    out = tmp_path_factory.mktemp("site")
    command = [sys.executable, "-m", "sphinx", "-q", "-W", "--keep-going"]
    done = subprocess.run(
        [*command, "-d", out / "trees", DOCS, out / "html"],
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    return out / "html"


@pytest.fixture(scope="module")
def installed(tmp_path_factory):
    out = tmp_path_factory.mktemp("installed")
    write_html(DOCS, out)
    return out


@pytest.mark.parametrize("form", [pytest.param("site", marks=pytest.mark.slow), "installed"])
def test_built_pages_name_no_script_style_or_image_of_another_host(form, request):
    built = request.getfixturevalue(form)
    for page in built.rglob("*.html"):
        text = page.read_text("utf-8")
        foreign = re.findall(
            r'<(?:script|img|link|iframe)\b[^>]*(?:src|href)="(?:https?:)?//', text
        )
        assert not foreign, page


@needs_browser
@pytest.mark.parametrize("form", ["site", "installed"])
def test_every_page_opens_offline_and_fits_a_narrow_screen(form, request, chromium):
    built = request.getfixturevalue(form)
    assert {str(p.relative_to(built).with_suffix("")) for p in built.rglob("*.html")} >= set(PAGES)
    with opened(chromium, "about:blank", **NARROW_DARK) as page:  # one renderer for all
        for name in PAGES:
            page.goto((built / f"{name}.html").as_uri())
            width = page.evaluate("document.documentElement.scrollWidth")
            assert width <= 400, f"{name} is {width} px wide"


@needs_browser
@pytest.mark.parametrize("form", ["site", "installed"])
def test_formulas_are_drawn_without_a_script(form, request, chromium):
    built = request.getfixturevalue(form)
    with opened(chromium, (built / "explanation/mathematics.html").as_uri(), **WIDE) as page:
        assert page.locator("math[display=block]").first.bounding_box()["height"] > 20


@needs_browser
@pytest.mark.parametrize("name", ["index", "explanation/mathematics", "how-to/extend"])
def test_installed_pages_have_no_serious_fault_of_accessibility(name, installed, chromium):
    with opened(chromium, (installed / f"{name}.html").as_uri(), **NARROW_DARK) as page:
        assert serious(page) == []


def test_links_of_installed_pages_lead_to_pages_and_headings(installed):
    for name in PAGES:
        page = installed / f"{name}.html"
        for link in re.findall(r'(?:href|src)="([^":]*)"', page.read_text("utf-8")):
            path, _, anchor = link.partition("#")
            target = (page.parent / path).resolve() if path else page
            assert target.is_file(), f"{name}: {link}"
            assert not anchor or f'id="{anchor}"' in target.read_text("utf-8"), f"{name}: {link}"


def test_index_leads_to_every_page(installed):
    index = (installed / "index.html").read_text("utf-8")
    assert [name for name in PAGES if name != "index" and f'"{name}.html' not in index] == []


def test_pages_keep_the_limits_of_words():
    words = page_words()
    assert {page: n for page, n in words.items() if n > PAGE_MAX} == {}
    assert sum(words.values()) <= TOTAL_MAX, "cut what a reader does not need to act or decide"


def test_every_file_that_a_command_of_a_page_reads_can_be_written_by_a_block_or_an_example():
    texts = {page: page.read_text("utf-8") for page in [ROOT / "README.md", *PAGES.values()]}
    examples = {name for text in texts.values() for name in EXAMPLE.findall(text)}
    unknown = []
    for page, text in texts.items():
        blocks = re.findall(r"```(\w+)\n(.*?)```", text, re.DOTALL)
        written = {name for _, block in blocks for name in NAMED_FILE.findall(block[:99])[:1]}
        written |= {name for pair in WRITES.findall(text) for name in pair} | examples
        if "estune remedy" in text:
            written.add("coulomb_friction.remedy.json")
        commands = [block for language, block in blocks if language in ("bash", "shell")]
        named = FILE.findall(re.sub(r"#.*", "", "".join(commands)))
        unknown += [
            f"{page.name}: {name}"
            for name in named
            if name not in written and not (ROOT / name).is_file()
        ]
    assert unknown == []


@pytest.mark.parametrize("name", ["README.md", "CONTRIBUTING.md"])
def test_links_of_pages_at_the_root_lead_to_files(name):
    links = re.findall(r"\]\(([^):]+)\)", (ROOT / name).read_text("utf-8"))
    assert [link for link in links if not (ROOT / link.partition("#")[0]).exists()] == []


@pytest.mark.parametrize("name", ["README.md", "CONTRIBUTING.md"])
def test_files_that_pages_at_the_root_name_exist(name):
    text = (ROOT / name).read_text("utf-8")
    named = re.findall(r"`((?:\w[\w.-]*/)+[\w.-]+\.(?:py|md|toml|c))`", text)
    assert [path for path in named if "NAME" not in path and not (ROOT / path).is_file()] == []


@pytest.mark.parametrize("line", ["estune tune x --no-such-option 1", "estune tunes x", "for"])
def test_wrong_command_in_a_page_is_found(line):
    with pytest.raises((CycloptsError, subprocess.CalledProcessError)):
        check_commands(line)


def test_modules_that_pages_run_exist():
    for page in [ROOT / "README.md", *PAGES.values()]:
        for module in re.findall(r"python -m ([a-z]\w*(?:\.\w+)*)", page.read_text("utf-8")):
            assert importlib.util.find_spec(module), f"{page}: {module}"


def test_command_prints_the_folder_of_the_pages(capsys):
    assert run(["docs", "--path"]) == 0
    assert capsys.readouterr().out.strip() == str(documentation_folder())


def test_command_opens_the_page_that_is_named(capsys, monkeypatch):
    shown = []
    monkeypatch.setattr("webbrowser.open", shown.append)
    assert run(["docs", "security"]) == 0
    assert shown[0].endswith("/how-to/security.html")
    assert shown[0] in capsys.readouterr().out


def test_unknown_page_is_answered_with_the_nearest(capsys):
    assert run(["docs", "secutiry"]) == 2
    assert "did you mean security?" in capsys.readouterr().err
