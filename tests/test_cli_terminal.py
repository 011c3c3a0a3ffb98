"""What commands print on a narrow terminal, to a shell, and to a script."""

import io
import subprocess
import threading

import pytest
from rich.console import Console

import estune
import plants
from estune.cli import app, output, run
from estune.cli.values import command_line
from estune.remote import zenoh
from estune.run.progress import showing_phases
from estune.tuners import TUNERS


@pytest.fixture
def terminal(monkeypatch):
    """A function that returns what a terminal of 80 columns shows."""
    stream = io.StringIO()
    shown = Console(file=stream, width=80, force_terminal=True, color_system=None)
    monkeypatch.setattr(output, "console", lambda: shown)
    return stream.getvalue


@pytest.fixture(scope="module")
def endpoint():
    with zenoh.serve(plants.reference_reel().rig(), ledger=None) as server:
        yield server.endpoint


@pytest.mark.parametrize("columns", [3, 12], ids=["as a table", "as lists"])
def test_table_on_a_narrow_terminal_cuts_nothing(columns, terminal):
    rows = [[f"value-{n}-{m}" for m in range(columns)] for n in range(3)]
    rows[1][-1] = "a sentence of many words, as the reason of a run that cannot be read"
    output.show_table([f"column-{m}" for m in range(columns)], rows)
    assert max(map(len, terminal().splitlines())) <= 80
    words = terminal().split()
    assert {word for row in rows for cell in row for word in cell.split()} <= set(words)


def test_wrong_verb_is_answered_with_the_choices_and_the_nearest(capsys):
    assert run(["daemon-control", "stat", "tcp/127.0.0.1:1"]) == 2
    error = capsys.readouterr().err
    assert '"status", "history", "events", "accept", "reject"' in error
    assert 'Did you mean "status"?' in error


def test_wrong_attribute_is_answered_with_the_nearest(capsys):
    assert run(["tune", "plants:refrence_reel"]) == 2
    assert "did you mean plants:reference_reel?" in capsys.readouterr().err


def test_shell_completes_commands_and_options(tmp_path, monkeypatch):
    monkeypatch.setenv("SHELL", "/bin/bash")
    script = tmp_path / "estune"
    script.write_text(app.generate_completion())
    lines = (
        f". {script}",
        "COMP_WORDS=(estune daemon-); COMP_CWORD=1; _estune; echo ${COMPREPLY[@]}",
        "COMP_WORDS=(estune tune x --tole); COMP_CWORD=3; _estune; echo ${COMPREPLY[@]}",
    )
    done = subprocess.run(["bash", "-c", "\n".join(lines)], capture_output=True, check=True)
    assert done.stdout.split() == [b"daemon-control", b"--tolerance"]


def test_shell_completes_names_of_tuners_and_of_runs(tmp_path, capsys):
    estune.tune(plants.reference_reel(), folder=tmp_path, run="monday", trials=1, watch=None)
    for words, names in (
        (["tune", "x", "--tuner", ""], list(TUNERS)),
        (["resume", "--folder", str(tmp_path), ""], ["monday"]),
    ):
        run(["__complete", *words])
        offered = capsys.readouterr().out.partition("begin\n")[2].splitlines()
        assert [line.partition("\t")[0] for line in offered] == names


def test_hint_after_a_stop_is_a_command_that_clears_it(endpoint, capsys):
    assert run(["estop", endpoint]) == 0
    words = capsys.readouterr().out.rpartition("reset it with: estune ")[2].split()
    assert run(words) == 0
    assert "is cleared" in capsys.readouterr().out


def test_command_line_quotes_words_and_leaves_out_what_is_not_given():
    line = command_line("apply", "my run", "tcp/[::1]:1", rig=None, security="a b.toml")
    assert line == "estune apply 'my run' 'tcp/[::1]:1' --security 'a b.toml'"


def test_second_server_of_a_ledger_is_offered_another_name(tmp_path, capsys):
    book = tmp_path / "reel.ledger"
    with zenoh.serve(plants.reference_reel().rig(), ledger=book):
        assert run(["serve", "--ledger", str(book)]) == 4
    error = capsys.readouterr().err
    assert "--name reel-2" in error
    assert "--ledger" in error


def test_phases_are_shown_with_an_estimate_and_again_for_later_work(capsys):
    with showing_phases(quiet=False) as progress:
        for phase, done in [("reading", 0.0), ("fitting", 0.5), ("done", 1.0)] * 2:
            progress(phase, done)
    lines = capsys.readouterr().err.splitlines()
    assert [line.split()[-1] for line in lines] == ["reading", "fitting", "done"] * 2
    assert "50 of 100 %" in lines[1]
    assert "left" in lines[1]
    assert not [thread for thread in threading.enumerate() if "refresh" in type(thread).__name__]
