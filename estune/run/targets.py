"""From what a user names as a target to a rig that answers."""

import functools
import importlib
import inspect
import re
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

from estune.errors import InvalidInput
from estune.trial import Rig

if TYPE_CHECKING:
    from estune.remote.security import Security

MODEL_FILE = ".toml"
_READER = "plants:load_model"
"""What reads a model file; by name as a user's own plant is, for plants are built on estune."""

_ENDPOINT = re.compile(r"(tcp|udp|tls|quic|ws|serial|unixsock-stream)/.+")


def is_endpoint(target: object) -> bool:
    """Whether the target is the address of a rig on the network, such as tcp/127.0.0.1:7447."""
    return isinstance(target, str) and _ENDPOINT.fullmatch(target) is not None


@contextmanager
def open_target(
    target: Any, rig: str | None = None, security: "Security | None" = None
) -> Iterator[Rig]:
    """The rig a user means, for as long as the block lasts.

    Args:
        target: An endpoint ("tcp/127.0.0.1:7447"), a model file ("reel.toml"), "module:attribute"
            naming a plant or a rig, a plant (anything with a `.rig()` method), or a rig.
        rig: Name of the rig, where several answer at the endpoint.
        security: Who this is, where the rig at the endpoint asks.

    Raises:
        InvalidInput: the target is none of these.
        RigError: nothing, or not the rig meant, answers at the endpoint.
    """
    if isinstance(target, str) and is_endpoint(target):
        from estune.remote import zenoh  # noqa: PLC0415  loads the network only where there is one
        from estune.remote.security import OPEN  # noqa: PLC0415  as above

        remote = zenoh.connect(target, rig=rig, security=security or OPEN)
        try:
            yield remote
        finally:
            remote.close()
        return
    if isinstance(target, str):
        target = load(target)
    if hasattr(target, "rig"):
        made: Rig = target.rig()
        try:
            yield made
        finally:
            made.close()
    elif hasattr(target, "describe") and hasattr(target, "run"):
        yield target
    else:
        raise InvalidInput(
            f"a {type(target).__name__} is no target: give an endpoint (tcp/127.0.0.1:7447), "
            "a plant (plants.reference_reel()) or a rig; wrap a python-control system in "
            "plants.linear_plant and a function in plants.python_plant"
        )


def load(reference: str, settings: Mapping[str, Any] | None = None) -> Any:
    """The model of a file, or what "module:attribute" names.

    A function or class is called with the settings; in a file they come before what it says.

    Raises:
        InvalidInput: there is no such file, module or attribute, or it does not take the settings.
    """
    if reference.endswith(MODEL_FILE):
        return load(_READER, {"model": reference, **(settings or {})})
    module_name, colon, attribute = reference.partition(":")
    if not colon or not module_name or not attribute:
        raise InvalidInput(
            f"{reference!r} is neither an endpoint such as tcp/127.0.0.1:7447, nor a model file "
            "such as reel.toml, nor module:attribute such as plants:reference_reel"
        )
    try:
        found = getattr(importlib.import_module(module_name), attribute)
    except ModuleNotFoundError as error:
        raise InvalidInput(f"{reference}: there is no module {error.name!r}") from error
    except AttributeError as error:
        raise InvalidInput(f"{reference}: {module_name} has no {attribute!r}") from error
    if not (isinstance(found, type | functools.partial) or inspect.isroutine(found)):
        if settings:
            raise InvalidInput(
                f"{reference} is made already and takes no settings {dict(settings)}"
            )
        return found
    try:
        inspect.signature(found).bind(**(settings or {}))
    except TypeError as error:
        raise InvalidInput(f"{reference}: {error}") from error
    return found(**(settings or {}))
