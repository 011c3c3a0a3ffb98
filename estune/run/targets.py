"""The rig that a target names: an endpoint, a model file, module:attribute, or an object."""

import difflib
import functools
import importlib
import inspect
import re
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from estune.core.gains import Gains
from estune.errors import InvalidInput
from estune.remote.state_machine.client import PATIENCE_S
from estune.support.plugins import hidden_hint, hiding_hint, load_plugin, plugins
from estune.trial import Rig

if TYPE_CHECKING:
    from estune.remote.security import Security

MODEL_FILE = ".toml"
"""Ending of a model file; the entry point group `estune.model_files` offers its reader."""

OBJECT = "object"
"""Name in that group of what makes a plant of an object: a linear system or a function."""

_ENDPOINT = re.compile(r"(tcp|udp|tls|quic|ws|serial|unixsock-stream)/.+")


def is_endpoint(target: object) -> bool:
    """Whether the target is meant as the address of a rig, such as tcp/127.0.0.1:7447.

    So is one of a transport that a connection then refuses: it is no model file.
    """
    return isinstance(target, str) and _ENDPOINT.fullmatch(target) is not None


@contextmanager
def open_target(
    target: Any,
    rig: str | None = None,
    security: "Security | None" = None,
    patience_s: float | None = None,
    *,
    dead_time_s: float | None = None,
    sampling_Hz: float | None = None,
    gains: Gains | None = None,
) -> Iterator[Rig]:
    """The rig that a target names, for the duration of the block.

    Args:
        target: An endpoint ("tcp/127.0.0.1:7447"), a model file ("reel.toml"), "module:attribute"
            naming a plant or a rig, a plant (anything with a `.rig()` method), a linear system, a
            function, or a rig.
        rig: Name of the rig, if several answer at the endpoint.
        security: Credentials, if the rig at the endpoint requires authentication.
        patience_s: How long to wait for the rig at the endpoint to appear, and where it stops
            replying, s; 3 s and 30 s by default.
        dead_time_s: Dead time of a linear system or a function, s.
        sampling_Hz: Rate of the controller of a linear system or a function.
        gains: Live gains of a linear system or a function.

    Raises:
        InvalidInput: the target is none of these, or has a dead time or rate of its own.
        RigError: no rig, or none of that name, answers at the endpoint.
    """
    own = {"dead_time_s": dead_time_s, "sampling_Hz": sampling_Hz}
    given = {name: value for name, value in own.items() if value is not None}
    if isinstance(target, str) and is_endpoint(target):
        _check_no_settings(given, target)
        from estune.remote import zenoh  # noqa: PLC0415  slow to import
        from estune.remote.security import OPEN  # noqa: PLC0415  as above

        remote = zenoh.connect(
            target,
            rig=rig,
            found_within_s=patience_s,
            patience_s=PATIENCE_S if patience_s is None else patience_s,
            security=security or OPEN,
        )
        try:
            yield remote
        finally:
            remote.close()
        return
    if isinstance(target, str):
        target = load(target)
    is_rig = hasattr(target, "describe") and hasattr(target, "run")
    if is_rig or hasattr(target, "rig"):
        _check_no_settings(given, type(target).__name__)
    else:
        target = _reader(OBJECT)(target, gains=gains, **given)
    if hasattr(target, "rig"):
        simulated: Rig = target.rig()
        try:
            yield simulated
        finally:
            simulated.close()
    else:
        yield target


def _check_no_settings(given: Mapping[str, float], target: str) -> None:
    if given:
        raise InvalidInput(
            f"{' and '.join(given)} are given for {target}, which has its own; they belong to a "
            "linear system or a function: change them in the plant or the rig's file"
        )


def load(reference: str, settings: Mapping[str, Any] | None = None) -> Any:
    """The model of a file, or the object that "module:attribute" names.

    A function or class is called with the settings; they override those of a file.

    Raises:
        InvalidInput: there is no such file, module or attribute, or it does not take the settings.
    """
    settings = settings or {}
    if reference.endswith(MODEL_FILE):
        return _reader(MODEL_FILE)(reference, **settings)
    target = _attribute(reference)
    if not (isinstance(target, type | functools.partial) or inspect.isroutine(target)):
        if settings:
            raise InvalidInput(f"{reference} is an object; it takes no settings {dict(settings)}")
        return target
    try:
        inspect.signature(target).bind(**settings)
    except TypeError as error:
        raise InvalidInput(f"{reference}: {error}") from error
    return target(**settings)


def check_reference(reference: str) -> None:
    """Refuses a model file or "module:attribute" that does not exist; calls nothing.

    Raises:
        InvalidInput: there is no such file, module or attribute.
    """
    if not reference.endswith(MODEL_FILE):
        _attribute(reference)
    elif not Path(reference).is_file():
        raise InvalidInput(f"{reference}: there is no such model file")


def _attribute(reference: str) -> Any:
    module_name, colon, attribute = reference.partition(":")
    if not attribute.isidentifier():
        from estune.remote.zenoh.endpoints import intended_endpoint  # noqa: PLC0415  slow to import

        intended = intended_endpoint(reference)
        if intended:
            raise InvalidInput(f"{reference!r} is no target; did you mean {intended}?")
    if not colon or not module_name or not attribute:
        raise InvalidInput(
            f"{reference!r} is neither an endpoint such as tcp/127.0.0.1:7447, nor a model file "
            "such as reel.toml, nor module:attribute such as plants:reference_reel"
        )
    try:
        module = importlib.import_module(module_name)
        return getattr(module, attribute)
    except ModuleNotFoundError as error:
        hint = hiding_hint(module_name)
        raise InvalidInput(
            f"{reference}: there is no module {error.name!r}{hint and f'; {hint}'}"
        ) from error
    except AttributeError as error:
        nearest = difflib.get_close_matches(attribute, dir(module), 1)
        meant = f"did you mean {module_name}:{nearest[0]}?" if nearest else ""
        hint = hidden_hint(module_name) or meant or hiding_hint(module_name)
        raise InvalidInput(
            f"{reference}: {module_name} has no {attribute!r}{hint and f'; {hint}'}"
        ) from error


def _reader(of: str) -> Callable[..., Any]:
    readers = plugins("estune.model_files")
    if of not in readers:
        raise InvalidInput("no installed package reads models; reinstall estune")
    reader: Callable[..., Any] = load_plugin(readers[of])
    return reader
