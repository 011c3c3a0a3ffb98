"""`estune remedy` and `estune prove`: a remedy as a patch of a rig's file, and its proof."""

import sys
from dataclasses import replace
from pathlib import Path

from rich.prompt import Confirm
from rich.text import Text

from estune.cli import output
from estune.cli.values import Flag, RigName, SecurityFile, command_line, security_from
from estune.errors import InvalidInput
from estune.proof.patch import SUFFIX, Patch, patch_of, read_patch
from estune.run.targets import open_target


def remedy(
    diagnosis: Path,
    /,
    *,
    rig: Path,
    effect: str | None = None,
    out: Path | None = None,
) -> None:
    """Write the remedy of a diagnosis as a patch of a rig's file. Nothing is changed.

    Args:
        diagnosis: The diagnosis, JSON of estune explain --json.
        rig: The rig's file, such as my-rig.toml.
        effect: The effect to be remedied, whatever is predicted; by default that of the greatest
            predicted gain.
        out: The patch; EFFECT.remedy.json beside the rig's file by default.

    Raises:
        InvalidInput: the diagnosis offers no remedy for the loop, with the reason for each, the
            rig's file has its table already, or the patch is there and has other numbers proven.
    """
    patch = patch_of(diagnosis, effect)
    change = patch.diff(rig)
    check_applied(patch, rig)
    path = out or rig.with_name(f"{patch.effect}{SUFFIX}")
    patch.with_proof_of(path).write(path)
    print(change, end="")
    output.show_next(
        {
            "patch": path,
            **_predicted(patch),
            "may harm": patch.harm,
            "prove it": command_line("prove", path, "ENDPOINT"),
            "then": command_line("apply", path, rig),
        }
    )


def _predicted(patch: Patch) -> dict[str, object]:
    """The prediction of a patch, ratios with to without; nothing where there is none."""
    ratios = (
        f"{n} {r['value']:.2f} [{r['low']:.2f}, {r['high']:.2f}]"
        for n, r in patch.predicted.items()
    )
    told = ", ".join(ratios)
    at = ",".join(f"{name}={value:.4g}" for name, value in patch.gains.items())
    of = f"{told}, of what they are without it{f', at {at}' if at else ''}"
    return {"predicted": of} if told else {}


def prove(
    patch: Path,
    target: str,
    /,
    *,
    pairs: int = 2,
    trials: int = 20,
    yes: Flag = False,
    rig: RigName = None,
    security: SecurityFile = None,
) -> int:
    """Prove a remedy on a rig: trials with it and without, at the live gains, then a tuning.

    The remedy is on during its own trials alone, and the rig's gains stay as they are.

    Args:
        patch: The patch, as estune remedy writes it; the result is added to it. A diagnosis is
            also taken, JSON of estune explain --json: its remedy of the greatest predicted gain
            is proven, and becomes a patch beside it.
        target: The rig: an endpoint such as tcp/127.0.0.1:7447.
        pairs: Pairs of trials with it and without; 2 show 5 % of a cost, 16 show 1 %.
        trials: Trials of the tuning with it on, where it is proven; 0 for none.
        yes: Begin without a prompt.

    Exits with 1 where the remedy is not proven.

    Raises:
        InvalidInput: the patch cannot be read, a patch beside the diagnosis has other numbers
            proven, or the rig's limits do not allow its trials.
        RigError: the rig cannot be reached, or cannot run trials with a remedy.
    """
    from estune import api  # noqa: PLC0415  slow to import
    from estune.proof.trials import RemedyRig  # noqa: PLC0415  as above
    from estune.proof.trials import prove as run  # noqa: PLC0415  as above

    if patch.name.endswith(SUFFIX):
        told = read_patch(patch)
    else:
        told = patch_of(patch)
        patch = patch.with_name(f"{told.effect}{SUFFIX}")
        told = told.with_proof_of(patch)
    with open_target(target, rig, security_from(security)) as the_rig:
        about = the_rig.describe()
        if not yes:
            _confirm(told, about.name, pairs)
        proof = run(the_rig, told, pairs=pairs, say=_say)
        if proof.proven and trials:
            _say("tuning with the remedy on")
            tuned = api.tune(RemedyRig(the_rig, told), trials=trials, journal=False, watch=None)
            if tuned.tuned is not None:
                proof = replace(proof, tuned=(tuned.start.cost, tuned.tuned.cost))
    told = replace(told, proof=proof.to_json())
    told.write(patch)
    state = "PROVEN" if proof.proven else "NOT PROVEN"
    output.show_outcome(f"{state}: {proof.sentence}", good=proof.proven)
    facts: dict[str, object] = {"patch": patch}
    if proof.proven:
        facts["apply it"] = command_line("apply", patch, "my-rig.toml")
    output.show_next(facts)
    return 0 if proof.proven else 1


def apply_patch(file: Path, rig_file: Path, *, yes: bool) -> None:
    """Adds a remedy to a rig's file, after a look at the change and at its proof.

    Raises:
        InvalidInput: a file cannot be read, the rig's file has the table already, or nobody
            confirmed.
    """
    patch = read_patch(file)
    text = check_applied(patch, rig_file)
    print(patch.diff(rig_file), end="")
    output.console().print(Text(patch.status, style="bold" if patch.proven else "bold yellow"))
    if not (yes or _asked(f"Add this to {rig_file}?")):
        raise InvalidInput(f"nobody confirmed: {rig_file} stays as it is; use --yes, or edit it")
    from estune.support.whole_file import write_file  # noqa: PLC0415  with its reason to write

    write_file(rig_file, text.encode())
    output.show_next({"changed": rig_file, "in force": "from the rig's next start"})


def check_applied(patch: Patch, rig_file: Path) -> str:
    """Text of the rig's file with the patch, checked as at the rig's start.

    Raises:
        InvalidInput: it would be refused.
    """
    import tomllib  # noqa: PLC0415  of this check alone

    from estune.hardware.config import config_from  # noqa: PLC0415  slow to import

    text = patch.applied(rig_file)
    try:
        config_from(tomllib.loads(text), str(rig_file))
    except tomllib.TOMLDecodeError as error:
        raise InvalidInput(f"{rig_file} with the patch is no TOML: {error}") from error
    return text


def _confirm(patch: Patch, name: str, pairs: int) -> None:
    told = f"{patch.title}: {patch.toml()}May harm: {patch.harm or 'nothing known'}"
    output.show_line(told)
    if not _asked(f"Run {4 * pairs} trials on rig {name}, half of them with it?"):
        raise InvalidInput("nobody confirmed: no trial was run; use --yes")


def _asked(question: str) -> bool:
    return sys.stdin.isatty() and Confirm.ask(question, default=False)


def _say(text: str) -> None:
    print(text, file=sys.stderr, flush=True)
