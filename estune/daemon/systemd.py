"""What a service tells systemd: that it is ready, what it does, that it lives (sd_notify(3))."""

import logging
import os
import socket
from collections.abc import Mapping

_log = logging.getLogger(__name__)


class Notifier:
    """Sends datagrams to the socket that systemd names; without one, nothing.

    Attributes:
        watchdog_s: How often at least a sign of life is wanted; None if it is not.
    """

    def __init__(self, environment: Mapping[str, str] = os.environ) -> None:
        self._address = environment.get("NOTIFY_SOCKET", "")
        if self._address.startswith("@"):  # in the abstract name space
            self._address = "\0" + self._address[1:]
        wanted_us = environment.get("WATCHDOG_USEC", "")
        own = environment.get("WATCHDOG_PID", str(os.getpid())) == str(os.getpid())
        usable = own and wanted_us.isdigit() and int(wanted_us) > 0
        self.watchdog_s = int(wanted_us) / 1e6 if usable else None

    def tell(self, **facts: object) -> None:
        """Sends facts, such as `READY=1`; a line break in one would begin another."""
        if not self._address:
            return
        lines = (f"{name}={' '.join(str(value).split())}" for name, value in facts.items())
        try:
            with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_CLOEXEC) as sender:
                sender.sendto("\n".join(lines).encode(), self._address)
        except OSError as error:
            _log.warning("systemd could not be told: %s", error)
