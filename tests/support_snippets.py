"""Snippets of README.md and docs/, run as tests: every fenced block, by its language.

| language | what is done |
| --- | --- |
| python | run; with prompts its output is compared |
| bash | run in the page's folder; background programs end with the page |
| | commands of estune without anything of the shell are run in this process |
| shell | for other machines or hardware: syntax and options are checked |
| toml, json | parsed |
| c | compiled |
| text | output, diagrams and formulas: nothing, but commands are refused |

A block whose first line is a comment with a file's name is written to that file, for the blocks
after it. In commands and files a port of 127.0.0.1 stands for a free one, and RUN for the newest
run.
"""

import contextlib
import doctest
import importlib.util
import io
import json
import os
import re
import shlex
import signal
import socket
import subprocess
import sys
import tempfile
import time
import tomllib
from itertools import takewhile
from pathlib import Path
from unittest.mock import patch

import pytest
from cyclopts import ValidationError
from sybil import Region, Sybil
from sybil.evaluators.doctest import DocTestEvaluator
from sybil.evaluators.python import PythonEvaluator
from sybil.parsers.abstract.doctest import DocTestStringParser
from sybil.parsers.markdown.lexers import RawFencedCodeBlockLexer

from estune.cli import app, run

ROOT = Path(__file__).parents[1]
LONGEST_S = 300.0
NAMED_FILE = re.compile(r"(?:#|//|/\*) ([\w.-]+\.[a-z]+)\b")
OPERATORS = {">", "|", "&", "&&"}
SHELL = re.compile(r"[^\w\s./:=,-]")
"""What a shell may take for something else than a part of a word."""
COMMAND = re.compile(r"^\s*(?:estune|python|\./dev|pip) ", re.MULTILINE)


class Page:
    """Folder, ports and background programs of one page."""

    def __init__(self):
        self._temporary = tempfile.TemporaryDirectory(ignore_cleanup_errors=True)
        self.folder = Path(self._temporary.name)
        self._before = Path.cwd()
        self._ports = {}
        self._groups = []
        os.chdir(self.folder)
        sys.path.insert(0, str(self.folder))  # for modules that the page writes

    def here(self, text):
        """The text with free ports, and the newest run for RUN."""
        text = re.sub(r"(?<=127\.0\.0\.1:)[1-9]\d*", lambda m: self._port(m[0]), text)
        runs = sorted(Path("runs").glob("*"), key=lambda run: run.stat().st_mtime)
        return re.sub(r"\bRUN\b", runs[-1].name, text) if runs else text

    def run(self, script):
        commands = plain_commands(script)
        if commands is None:
            self._run_in_shell(script)
        for command in commands or ():
            code, said = _run_here(command)
            assert code == 0, f"exit code {code}:\n{said}"

    def _run_in_shell(self, script):
        log = self.folder / f".log{len(self._groups)}"
        path = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
        with log.open("w") as output:
            program = subprocess.Popen(
                ["bash", "-euo", "pipefail", "-c", script],
                env={**os.environ, "PATH": path, "COLUMNS": "100"},
                stdin=subprocess.DEVNULL,
                stdout=output,
                stderr=subprocess.STDOUT,
                start_new_session=True,
            )
        self._groups.append(program.pid)
        code = program.wait(LONGEST_S)
        assert code == 0, f"exit code {code}:\n{log.read_text()}"
        if script.rstrip().endswith("&"):
            for port in re.findall(r"127\.0\.0\.1:(\d+)", script):
                _await(int(port))
            for endpoint in re.findall(r"--listen (\S+)", script):
                _await_rig(endpoint)

    def close(self):
        for group in self._groups:
            _end(group)
        os.chdir(self._before)
        sys.path.remove(str(self.folder))
        for name, module in [*sys.modules.items()]:  # another page may write one of that name
            if (getattr(module, "__file__", None) or "").startswith(str(self.folder)):
                del sys.modules[name]
        self._temporary.cleanup()

    def _port(self, written):
        if written not in self._ports:
            with socket.socket() as free:
                free.bind(("127.0.0.1", 0))
                self._ports[written] = str(free.getsockname()[1])
        return self._ports[written]


def _run_here(command):
    """Exit code and output of a command in this process."""
    said = io.StringIO()
    with (
        contextlib.redirect_stdout(said),
        contextlib.redirect_stderr(said),
        patch.object(signal, "signal"),
        patch.dict(os.environ, COLUMNS="100"),
    ):
        return run(command), said.getvalue()


def _await_rig(endpoint):
    """Waits until a rig answers: the port listens a moment before."""
    for _ in range(round(LONGEST_S)):
        if _run_here(["discover", endpoint])[0] == 0:
            return
    raise TimeoutError(f"no rig answers at {endpoint}")


def _await(port):
    """Waits until a program listens at a port, as a reader does before the next command."""
    for _ in range(round(10 * LONGEST_S)):
        with contextlib.suppress(ConnectionRefusedError), socket.socket() as link:
            link.connect(("127.0.0.1", port))
            return
        time.sleep(0.1)
    raise TimeoutError(f"nothing listens at port {port}")


def _end(group):
    """Ends a process group, by force if it does not end by itself."""
    with contextlib.suppress(ProcessLookupError):
        os.killpg(group, signal.SIGTERM)
        for _ in range(100):
            time.sleep(0.1)
            os.killpg(group, 0)
        os.killpg(group, signal.SIGKILL)


def plain_commands(script):
    """The arguments of each command of estune; None if a line is anything else.

    In a process of its own each would import for two seconds. The blocks that need a shell start
    the installed program, as do the tests of the command line.
    """
    lines = [shlex.split(line, comments=True) for line in script.splitlines()]
    words = [line for line in lines if line]
    if all(line[0] == "estune" and not SHELL.search(" ".join(line)) for line in words):
        return [line[1:] for line in words]
    return None


def check_commands(text):
    """Checks the shell's syntax, and that the commands and options of estune exist."""
    subprocess.run(["bash", "-n", "-c", text], check=True)
    for line in text.replace("\\\n", " ").splitlines():
        words = [*takewhile(lambda word: word not in OPERATORS, shlex.split(line, comments=True))]
        words = [word for word in words if not word.startswith("$")]
        if words[:1] == ["estune"]:
            app.parse_args(words[1:], exit_on_error=False, print_error=False)
        if words[:2] == ["python", "-m"]:
            assert importlib.util.find_spec(words[2]), line


def refuse_commands(text):
    assert not COMMAND.search(text), (
        "a command in a block of text; name its language bash or shell"
    )


def compile_c(text):
    compiler = ["cc", "-std=c99", "-Wall", "-Werror", "-fsyntax-only", "-x", "c", "-"]
    subprocess.run(compiler, input=text.encode(), check=True)


CHECKS = {
    "c": compile_c,
    "json": json.loads,
    "shell": check_commands,
    "text": refuse_commands,
    "toml": tomllib.loads,
}


def evaluate(example):
    """Does with one block what its language asks for."""
    text, language = example.parsed, example.region.lexemes["language"]
    page = example.namespace["page"]
    if language == "bash":
        page.run(page.here(text))
        return
    named = NAMED_FILE.match(text)
    if named:
        Path(named[1]).write_text(page.here(text))
    elif language == "python":
        PythonEvaluator()(example)
    if language != "python":
        assert language in CHECKS, f"a block needs one of these languages: {', '.join(CHECKS)}"
        CHECKS[language](text)


class FencedBlocks:
    """Parser of all fenced blocks; those of directives in braces are Sphinx's."""

    lexer = RawFencedCodeBlockLexer(re.compile(r"(?P<language>[^\n]*)$\n", re.MULTILINE))
    doctests = DocTestStringParser(DocTestEvaluator(doctest.ELLIPSIS))

    def __call__(self, document):
        for region in self.lexer(document):
            source = region.lexemes["source"]
            if region.lexemes["language"].startswith("{"):
                continue
            if source.startswith(">>>"):
                for example in self.doctests(source, document.path):
                    example.adjust(region, source)
                    yield example
            else:
                yield Region(region.start, region.end, source, evaluate, region.lexemes)


class PageBlocks(pytest.Item):
    """All blocks of a page in order, in one folder and one namespace."""

    line = 1

    def runtest(self):
        document = SNIPPETS.parse(self.path)
        page = document.namespace["page"] = Page()
        try:
            for example in document.examples():
                self.line = example.line
                example.evaluate()
        finally:
            page.close()

    def reportinfo(self):
        return self.path, None, self.name

    def repr_failure(self, excinfo):
        return f"{self.path}:{self.line}\n{super().repr_failure(excinfo)}"


class PageCommands(pytest.Item):
    """The commands of a page of the slow lane exist, with their options."""

    def runtest(self):
        for text in programs(self.path):
            with contextlib.suppress(ValidationError):  # a value names what the page writes
                check_commands(text)

    def reportinfo(self):
        return self.path, None, self.name


def programs(path):
    """The blocks of a page that start programs."""
    regions = SNIPPETS.parse(path)
    return [
        e.parsed for e in regions.examples() if (e.region.lexemes or {}).get("language") == "bash"
    ]


class PageFile(pytest.File):
    """A page; of the slow lane if one of its blocks starts programs."""

    def collect(self):
        blocks = PageBlocks.from_parent(self, name="blocks")
        yield blocks
        if programs(self.path):
            blocks.add_marker("slow")
            yield PageCommands.from_parent(self, name="commands")


SNIPPETS = Sybil(
    parsers=[FencedBlocks()], patterns=["README.md", "docs/*.md", "docs/*/*.md"], path=str(ROOT)
)


def collected_page(file_path, parent):
    """What pytest collects of a file: its blocks, if it is a page."""
    if SNIPPETS.should_parse(file_path):
        return PageFile.from_parent(parent, path=file_path)
    return None
