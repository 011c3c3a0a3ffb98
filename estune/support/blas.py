"""BLAS on one thread, so that sums do not depend on the number of cores."""

import threading
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from typing import Any

_lock = threading.Lock()
_users = 0
_limits: Any = None


@cache
def _controller() -> Any:
    # SciPy's BLAS is one of its own, and must be loaded to be found.
    import scipy.linalg  # noqa: F401, PLC0415  slow to import
    from threadpoolctl import ThreadpoolController  # noqa: PLC0415  slow to import

    return ThreadpoolController()


def _take_control() -> None:
    """Lets this thread change the limit.

    Otherwise threadpoolctl ignores every thread but the first that changed it, while that lives.
    """
    from threadpoolctl import OpenBLASController  # noqa: PLC0415  slow to import

    OpenBLASController.clear_controlling_thread(force=True)


@contextmanager
def one_blas_thread() -> Iterator[None]:
    """Holds BLAS to one thread while any thread of the program is inside.

    The order of a sum, and with it its last bits, depends on the number of threads: a tuning
    continued on another machine would propose other gains. The matrices are small, too: a thread
    more costs more than it brings.
    """
    global _users, _limits  # noqa: PLW0603  the setting is one of the process
    with _lock:
        if _users == 0:
            _take_control()
            _limits = _controller().limit(limits=1, user_api="blas")
        _users += 1
    try:
        yield
    finally:
        with _lock:
            _users -= 1
            if _users == 0:
                _take_control()
                _limits.restore_original_limits()
