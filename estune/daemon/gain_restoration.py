"""Which gains are a rig's own, and how they come back onto it.

The gains a rig is found with are backed up before any others are put on it. Gains that nobody set
through this daemon are somebody else's, and are left as they are until somebody says otherwise.
"""

from estune.core.gains import Gains
from estune.daemon.events import EventKind
from estune.daemon.rig_access import RigAccess
from estune.daemon.supervised_rig import SupervisedRig
from estune.daemon.supervisor_state import GainSet
from estune.trial import RigDescription


def apply_nominal_gains(supervision: SupervisedRig, reached: RigAccess, home: GainSet) -> str:
    """Backs up the rig's gains the first time; puts the home ones on it.

    Returns:
        Why not, where somebody has to see to it; else empty.
    """
    about, store = reached.take(), supervision.store
    fault = _stranger(supervision, about)
    if not fault and store.gains() and about.gains not in store.all_gain_sets():
        fault = "" if store.fact("overrule") else _strange_gains(about)
    if fault:
        return fault
    store.put("overrule", None)
    if not store.gains():
        _back_up(supervision, about)
    gains = store.gains()[home]
    if about.gains != gains:
        reached.apply(gains)
        why = f"{home} gains are live: {supervision.life.why}"
        supervision.note(EventKind.GAINS, why, gains=str(gains))
    return ""


def restore_nominal_gains(supervision: SupervisedRig, reached: RigAccess, home: Gains) -> str:
    """Puts the home gains back; why they are not live, if they are not."""
    about, life = reached.take(), supervision.life
    if about.gains not in supervision.store.all_gain_sets():
        return _strange_gains(about)
    if about.gains != home:
        reached.apply(home)
        supervision.note(EventKind.GAINS, f"{life.home} gains are live: {life.why}")
    supervision.live = life.home
    return ""


def _stranger(supervision: SupervisedRig, about: RigDescription) -> str:
    """Why this is not the rig of the store; empty if it is."""
    then = supervision.store.fact("rig_facts")
    if then is None or then == _facts(about):
        return ""
    return (
        f"the rig says it is {about.name!r} with {about.newtons_per_ampere:g} N/A, the one backed "
        f"up in {supervision.store.folder} was {then['name']!r} with "
        f"{then['newtons_per_ampere']:g} N/A; "
        "connect that one, or give this one a name and a folder of its own"
    )


def _back_up(supervision: SupervisedRig, about: RigDescription) -> None:
    with supervision.store.writing():
        supervision.store.put("rig_facts", _facts(about))
        supervision.store.set_gains(
            GainSet.ORIGINAL, about.gains, "the rig ran them when it was found"
        )
    supervision.note(
        EventKind.BACKED_UP, f"the rig's own gains are kept: {about.gains}", gains=str(about.gains)
    )


def _facts(about: RigDescription) -> dict[str, str | float]:
    """What tells a rig from another."""
    return {"name": about.name, "newtons_per_ampere": about.newtons_per_ampere}


def _strange_gains(about: RigDescription) -> str:
    return (
        f"rig {about.name} runs {about.gains}, which were not set through this daemon; they are "
        "left as they are: resume puts back the home gains, revert the original ones"
    )
