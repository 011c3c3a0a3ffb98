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

from estune.errors import InvalidInput
from estune.remote.state_machine.client import PATIENCE_S
from estune.support.plugins import hidden_hint, hiding_hint, load_plugin, plugins
from estune.trial import Rig

if TYPE_CHECKING:
    from estune.remote.security import Security

MODEL_FILE = ".toml"
"""Ending of a model file; the entry point group `estune.model_files` offers its reader."""

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
) -> Iterator[Rig]:
    """The rig that a target names, for the duration of the block.

    Args:
        target: An endpoint ("tcp/127.0.0.1:7447"), a model file ("reel.toml"), "module:attribute"
            naming a plant or a rig, a plant (anything with a `.rig()` method), or a rig.
        rig: Name of the rig, if several answer at the endpoint.
        security: Credentials, if the rig at the endpoint requires authentication.
        patience_s: How long to wait for the rig at the endpoint to appear, and where it stops
            replying, s; 3 s and 30 s by default.

    Raises:
        InvalidInput: the target is none of these.
        RigError: no rig, or none of that name, answers at the endpoint.
    """
    if isinstance(target, str) and is_endpoint(target):
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
    if hasattr(target, "rig"):
        simulated: Rig = target.rig()
        try:
            yield simulated
        finally:
            simulated.close()
    elif hasattr(target, "describe") and hasattr(target, "run"):
        yield target
    else:
        raise InvalidInput(
            f"the target is of type {type(target).__name__}; give an endpoint "
            "(tcp/127.0.0.1:7447), a plant (plants.reference_reel()) or a rig; wrap a "
            "python-control system in plants.linear_plant and a function in plants.python_plant"
        )


def load(reference: str, settings: Mapping[str, Any] | None = None) -> Any:
    """The model of a file, or the object that "module:attribute" names.

    A function or class is called with the settings; they override those of a file.

    Raises:
        InvalidInput: there is no such file, module or attribute, or it does not take the settings.
    """
    settings = settings or {}
    if reference.endswith(MODEL_FILE):
        return _model_reader()(reference, **settings)
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


def _model_reader() -> Callable[..., Any]:
    readers = plugins("estune.model_files")
    if MODEL_FILE not in readers:
        raise InvalidInput("no installed package reads model files; reinstall estune")
    reader: Callable[..., Any] = load_plugin(readers[MODEL_FILE])
    return reader
