"""Who started this process."""

import getpass
import os
import socket


def user_name() -> str:
    """Name of the user, or the number of one who has no name."""
    try:
        return getpass.getuser()
    except (KeyError, OSError):
        return str(os.getuid())


def user_at_host() -> str:
    """The user's name with that of the machine."""
    return f"{user_name()}@{socket.gethostname()}"
