"""The number of files that this process may have open."""

import contextlib
import importlib


def allow_open_files(wanted: int) -> None:
    """Raises the limit to what the system lets this user have, up to so many; never lowers it."""
    try:
        resource = importlib.import_module("resource")
    except ImportError:  # a system without such limits
        return
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    unlimited = resource.RLIM_INFINITY
    wanted = wanted if hard == unlimited else min(wanted, hard)
    if soft != unlimited and soft < wanted:
        with contextlib.suppress(ValueError, OSError):
            resource.setrlimit(resource.RLIMIT_NOFILE, (wanted, hard))
