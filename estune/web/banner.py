"""The state of a rig or run in a few words, and the facts below it, from what a board holds."""

import math
from collections.abc import Iterator, Mapping
from datetime import UTC, datetime
from typing import Any, Literal, NamedTuple

from estune.run.ending import RunEnding
from estune.web.board import Board

STALE_S = 1.5
"""Age from which data of a rig or daemon are out of date: they are read four times a second."""
_SOURCES: tuple[str, ...] = ("daemon", "rig", "run")
_ENDED = {"stopped": "", "failed": "no", "interrupted": "no"}

Tone = Literal["", "yes", "no", "stale"]
Facts = list[tuple[str, str]]


class Banner(NamedTuple):
    """The state in a word and a sentence.

    Attributes:
        tone: Good, bad, out of date, or none of these.
    """

    word: str
    tone: Tone = ""
    sentence: str = ""


def show_banner(board: Board, kind: str) -> None:
    """Puts banner and facts of a view on its board."""
    names = ("rig", "daemon", "state", "run", "result", "description", "elsewhere", "begun")
    faults = (f"fault.{source}" for source in _SOURCES)
    values = {name: board.get(name) for name in (*names, *faults)}
    shown = banner(kind, values, board.ages(), datetime.now(UTC))
    state = values["state"]
    ended = kind == "run" and bool(state) and state["status"] != "running"  # nothing is read then
    board.put("banner", shown._asdict() | {"ended": ended})
    board.put("facts", facts(kind, values))


def banner(
    kind: str, values: Mapping[str, Any], ages: Mapping[str, float], now: datetime
) -> Banner:
    """The state that the values of a board show.

    Args:
        kind: Whether the page is that of a run, a rig or a daemon.
        ages: Time since each source answered, s.
    """
    return next(_banners(kind, values, ages, now))


def _banners(
    kind: str, values: Mapping[str, Any], ages: Mapping[str, float], now: datetime
) -> Iterator[Banner]:
    """What may be said, the most urgent first."""
    rig, daemon, state = (values.get(name) for name in ("rig", "daemon", "state"))
    is_running = state is not None and state["status"] == "running"
    yield from _without_link(kind, values, ages, needs_rig=kind != "run" or is_running)
    if rig and rig["latched"]:
        yield Banner("emergency stop", "no", rig["latched"])
    if daemon:
        fault = daemon["trouble"]
        tone: Tone = "no" if fault else "yes" if daemon["live"] and not daemon["paused"] else ""
        yield Banner(daemon["mode"], tone, fault or daemon["paused"] or daemon["sentence"])
    begun, run = values.get("begun"), values.get("run")
    if begun and (run is None or run["name"] != begun["run"]):  # its journal is not there yet
        fault = begun["fault"]
        yield (
            Banner("not started", "no", fault)
            if fault
            else Banner("starting", "yes", "a tuning begins")
        )
    if kind == "rig" and values.get("fault.run"):
        yield Banner("run not shown", "stale", values["fault.run"])
    if rig and (elsewhere := values.get("elsewhere")):
        yield _of_another(elsewhere, rig)
    if state and is_running:
        word = "aborting" if rig and rig["mode"] == "aborting" else "running"
        yield Banner(word, "yes", progress(state))
    if rig and rig["mode"] != "idle":
        holder = rig["holder"] or "nobody"
        yield Banner(rig["mode"], "yes", f"{rig['sentence']}; held by {holder}")
    if state:
        yield _ended(state, values, now)
    yield Banner(rig["mode"], "", rig["sentence"]) if rig else Banner("connecting")


def _without_link(
    kind: str, values: Mapping[str, Any], ages: Mapping[str, float], *, needs_rig: bool
) -> Iterator[Banner]:
    """The state of a page one of whose sources is lost."""
    for source in _SOURCES:
        fault = values.get(f"fault.{source}")
        silent_s = ages.get(source, 0.0)
        if not fault and (source == "run" or silent_s <= STALE_S):
            continue
        if (source == "rig" and not needs_rig) or (source == "run" and kind != "run"):
            continue  # of a run that has ended the journal is enough; a rig's page says it below
        why = fault or f"The {source} has not answered for {silent_s:.1f} s."
        yield Banner(f"no link to the {source}", "stale", why)


def _of_another(run: str, rig: Mapping[str, Any]) -> Banner:
    """The state of a rig that has last run trials of a run whose journal is not here."""
    where = "whose journal is not in this folder: costs and search are not shown"
    if rig["trial_id"]:
        number = rig["trial_id"].rpartition("-")[2].lstrip("0") or "0"
        return Banner(rig["mode"], "yes", f"trial {number} of run {run}, {where}")
    return Banner(rig["mode"], "", f"last held by run {run}, {where}")


def _ended(state: Mapping[str, Any], values: Mapping[str, Any], now: datetime) -> Banner:
    """The state after a run: how it ended, and when."""
    result, about = values.get("result"), values.get("description")
    word, _, reason = (part.strip() for part in state["status"].partition(":"))
    ended = ago(state["ended_at"], now)
    if word != "finished":
        tone: Tone = "no" if _ENDED.get(word) else ""
        rig = values.get("rig")
        # The reason is of then: after a reset it still asks for the stop to be cleared.
        now_is = f"the rig is {rig['mode']} now" if rig and reason else ""
        why = f"it ended with: {reason}" if now_is else reason
        return Banner(word, tone, "; ".join(filter(None, (ended, now_is, why))))
    if result is None:
        return Banner("finished", "", ended)
    ending, good, offer = (result.get(name) for name in ("ending", "good", "offer"))
    tone = "yes" if good else "no" if good is False else ""
    if about and offer and "gains" in offer:
        is_live = list(offer["gains"].values()) == about["gains"]
        ended += "; its gains are live" if is_live else "; its gains are not live"
    return Banner(_WORDS.get(ending, ending or "finished"), tone, ended)


_WORDS = {
    RunEnding.NO_IMPROVEMENT: "no improvement",
    RunEnding.LIMIT_BROKEN: "a limit is broken",
    RunEnding.LIMITS_NOT_SHOWN: "tuned, limits not shown",
}


def progress(state: Mapping[str, Any]) -> str:
    """Trials done, of how many, the phase, and the time left; trials themselves count from 0."""
    done, left = state["done"], state["left"]
    of = f" of {'at most ' if state['at_most'] else ''}{done + left}" if left else ""
    phase = f": {state['phase']}" if state["phase"] else ""
    time_s = state["trial_s"] and left and state["trial_s"] * left
    at_most = "at most" if state["at_most"] else "about"
    to_come = f"; {at_most} {duration(time_s)} left" if time_s and time_s >= 1.0 else ""
    return f"{done}{of} trials done{phase}{to_come}"


def facts(kind: str, values: Mapping[str, Any]) -> Facts:
    """What stands below the banner, by label."""
    return [*_facts(kind, values)]


def _facts(kind: str, values: Mapping[str, Any]) -> Iterator[tuple[str, str]]:
    rig, daemon, state, run = (values.get(name) for name in ("rig", "daemon", "state", "run"))
    if rig and rig["holder"]:
        yield "held by", rig["holder"]
    if daemon:
        yield from _daemon_facts(daemon)
    if run and kind != "run":
        yield "run", run["name"]
    if state:
        done, left = state["done"], state["left"]
        is_running = state["status"] == "running"
        bound = "at most" if state["at_most"] else "about"
        to_come = f", {bound} {left} left" if is_running and left else ""
        yield "trials", f"{done} done{to_come}"
        if is_running and state["trial_s"]:
            yield "time of a trial", duration(state["trial_s"])
        if state["unsafe"]:
            yield "unsafe trials", str(state["unsafe"])
        best = state["best"]
        if best and not values.get("result"):  # which gives the cost from all repeats
            yield "best cost", f"{best['cost']:.4g} in trial {best['number']}"
    if run and kind == "run":
        yield "rig", run["rig"]


def _daemon_facts(daemon: Mapping[str, Any]) -> Iterator[tuple[str, str]]:
    live = daemon["live"]
    if live:
        shown = ", ".join(f"{value:.4g}" for value in daemon["gains"][live])
        yield f"live gains ({live}): P, I, D, filter", shown
    else:
        yield "live gains", "not confirmed by the rig"
    if daemon["margins"]:
        yield "margins in service", daemon["margins"]
    if daemon["run"]:
        yield "tuning", f"{daemon['run']}, {daemon['trials']} of {daemon['trials_max']} trials"


def ago(at: str, now: datetime) -> str:
    """A time in the past in words."""
    past_s = (now - datetime.fromisoformat(at).astimezone()).total_seconds()
    return f"{duration(past_s)} ago" if past_s >= 1.0 else "just now"


_UNITS: tuple[tuple[float, float, str], ...] = (
    (90.0, 1.0, "s"),
    (5400.0, 60.0, "min"),
    (172_800.0, 3600.0, "h"),
    (math.inf, 86_400.0, "days"),
)


def duration(time_s: float) -> str:
    """A time in one unit, as people say it; below a second in milliseconds."""
    if 0.0 < time_s < 1.0:
        return f"{1e3 * time_s:.0f} ms"
    unit_s, name = next((unit, name) for most, unit, name in _UNITS if time_s < most)
    return f"{time_s / unit_s:.0f} {name}"
