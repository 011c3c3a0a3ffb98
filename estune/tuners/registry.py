"""The tuners there are, by name, and their stored form.

`TUNERS` is the only place that lists tuners: command line, settings files, stored plans and
documentation follow it. A user's own tuner is named "module:Class" wherever a name is expected.
It is a dataclass with the methods of `Tuner` whose fields all have defaults, but for `space`.

    tuner = create_tuner("otis", space)     # by name; InvalidInput names the tuners there are
    values = tuner_to_stored(tuner)         # {"kind": "otis", "space": {...}, settings ...}
    tuner = tuner_from_stored(values)       # JournalError where that is not possible

The stored kind is the registered name, or "module:Class" of a tuner outside the table.
`tuner_name(values)` and `tuner_space(values)` work for every stored tuner, also for one that
cannot be made here.
"""

import dataclasses
import importlib
from typing import Any, Final, NamedTuple, cast

from pydantic import TypeAdapter, ValidationError

from estune.errors import InvalidInput, JournalError
from estune.tuners.extremum_seeking import Otis, PhaseCompensated
from estune.tuners.identified_loop import IdentifiedLoopTuner
from estune.tuners.interface import Tuner
from estune.tuners.killingsworth import Killingsworth
from estune.tuners.least_squares_gradient import LeastSquaresGradient
from estune.tuners.safe_bayesian import SafeBayesianTuner
from estune.tuners.search_space import SearchSpace


class RegisteredTuner(NamedTuple):
    """A tuner of the table.

    Attributes:
        kind: The class; each is created from a search space, with defaults for all settings.
        method: Its method, as in the table of docs/explanation/tuners.md.
        purpose: Its use, as in that table.
    """

    kind: type[Any]
    method: str
    purpose: str


TUNERS: Final[dict[str, RegisteredTuner]] = {
    "model_based": RegisteredTuner(
        IdentifiedLoopTuner,
        "optimum of the loop identified from the records, within limits of sensitivity and "
        "overshoot; safe_bayesian where the model fails",
        "default",
    ),
    "safe_bayesian": RegisteredTuner(
        SafeBayesianTuner,
        "safe Bayesian optimisation: cost model with a prior from simulated PIDF loops, trust "
        "region, safety constraints",
        "cost alone: without limits, or without records",
    ),
    "least_squares_gradient": RegisteredTuner(
        LeastSquaresGradient,
        "slope of a regression on recent trials (section V-C of the paper)",
        "alternative",
    ),
    "phase_compensated": RegisteredTuner(
        PhaseCompensated,
        "extremum seeking whose demodulation accounts for the phase of its filters",
        "alternative",
    ),
    "otis": RegisteredTuner(
        Otis,
        "the paper's extremum seeking: logarithmic parameters, setpoint filter, washout and "
        "low-pass filter",
        "alternative",
    ),
    "killingsworth": RegisteredTuner(
        Killingsworth,
        "Killingsworth and Krstic 2006, the published equations verbatim",
        "to reproduce the paper",
    ),
}

DEFAULT_TUNER: Final = "model_based"
"""The tuner of a run for which none is named."""


def tuner_class(name: str) -> type[Any]:
    """The class of a registered tuner, or of a user's own by "module:Class".

    Raises:
        InvalidInput: there is no tuner of that name, or the class is not one.
    """
    if name in TUNERS:
        return TUNERS[name].kind
    module, colon, attribute = name.partition(":")
    if not colon:
        raise InvalidInput(
            f"there is no tuner {name!r}; the tuners are {', '.join(TUNERS)}, or module:Class"
        )
    try:
        kind = getattr(importlib.import_module(module), attribute)
    except ModuleNotFoundError as error:
        raise InvalidInput(f"tuner {name}: there is no module {error.name!r}") from error
    except ImportError as error:
        raise InvalidInput(f"tuner {name} cannot be imported: {error}") from error
    except (AttributeError, ValueError, TypeError) as error:  # the last of a relative name
        raise InvalidInput(f"tuner {name}: {module or 'the name'} has no {attribute!r}") from error
    methods = ("start", "ask", "tell", "recommend")
    if not (dataclasses.is_dataclass(kind) and all(hasattr(kind, method) for method in methods)):
        raise InvalidInput(
            f"tuner {name} must be a dataclass with the methods {', '.join(methods)}; see "
            "estune.tuners.Tuner"
        )
    return cast("type[Any]", kind)


def create_tuner(name: str, space: SearchSpace) -> Tuner[Any]:
    """The tuner of that name with its default settings.

    Raises:
        InvalidInput: there is no such tuner, or the search space does not suit it.
    """
    kind = tuner_class(name)
    try:
        made: Tuner[Any] = kind(space=space)
    except TypeError as error:
        raise InvalidInput(
            f"tuner {name} cannot be created from a search space alone: {error}"
        ) from error
    return made


def tuner_to_stored(tuner: Tuner[Any]) -> dict[str, Any]:
    """The kind of a tuner and its settings as JSON values; floats survive exactly.

    Raises:
        InvalidInput: the tuner is not a dataclass, so that its settings cannot be stored.
    """
    kind: type[Any] = type(tuner)
    if not dataclasses.is_dataclass(kind):
        raise InvalidInput(
            f"tuner {kind.__qualname__} is not a dataclass; only one can be journalled"
        )
    names = {entry.kind: name for name, entry in TUNERS.items()}
    settings = TypeAdapter(kind).dump_python(cast("Any", tuner), mode="json")
    return {"kind": names.get(kind, f"{kind.__module__}:{kind.__qualname__}"), **settings}


def tuner_from_stored(values: dict[str, Any]) -> Tuner[Any]:
    """The tuner that was stored.

    Raises:
        JournalError: the tuner is not part of this version, or its settings are not.
    """
    stored = dict(values)
    name = str(stored.pop("kind", ""))
    try:
        kind = tuner_class(name)
        if name in TUNERS:
            stored.pop("name", None)  # the registered name stands for it
        unknown = stored.keys() - {field.name for field in dataclasses.fields(kind)}
        if unknown:
            raise JournalError(
                f"the stored tuner {name} has settings of another version: "
                f"{', '.join(sorted(unknown))}"
            )
        tuner: Tuner[Any] = TypeAdapter(kind).validate_python(stored)
    except (InvalidInput, ValidationError) as error:
        raise JournalError(
            f"the stored tuner cannot be read ({error}); it is of another version"
        ) from error
    return tuner


def tuner_name(values: dict[str, Any]) -> str:
    """The name of a stored tuner, to be shown.

    Raises:
        JournalError: no tuner was stored.
    """
    kind = values.get("kind")
    if not isinstance(kind, str):
        raise JournalError("the stored plan names no tuner; it is of another version")
    return kind if kind in TUNERS else str(values.get("name", kind))


def tuner_space(values: dict[str, Any]) -> SearchSpace:
    """The search space of a stored tuner.

    Raises:
        JournalError: it is not of this version.
    """
    try:
        return TypeAdapter(SearchSpace).validate_python(values["space"])
    except (KeyError, ValidationError, InvalidInput) as error:
        raise JournalError(
            f"the stored search space cannot be read ({error}); it is of another version"
        ) from error
