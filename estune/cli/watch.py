"""`estune watch`: the live page of a run, a folder of runs, a rig or a daemon."""

import threading
from pathlib import Path
from typing import TYPE_CHECKING

from estune import api
from estune.cli.runs import find_run
from estune.cli.values import Flag, RunName, security_from
from estune.errors import RigError
from estune.remote.security import Security
from estune.run.journal import FILE_NAME
from estune.run.targets import is_endpoint

if TYPE_CHECKING:
    from estune.web.views import View, Views

PORT = 8765


def watch(
    *what: RunName,
    rig: str | None = None,
    port: int = PORT,
    host: str = "127.0.0.1",
    allow_commands: Flag = False,
    allow_remote: Flag = False,
    security: Path | None = None,
    folder: Path = Path(api.RUNS),
) -> None:
    """Show runs, rigs and daemons live on a page in the browser.

    The page shows; it commands nothing unless started with --allow-commands. It cannot slow or
    stop a run.

    Args:
        what: A run (its name, or its folder), a folder of runs, or the endpoint of rigs or of a
            daemon; several are on one page. The folder runs by default.
        rig: Name of one rig at the endpoint; all of them by default.
        port: Port of the page; 0 takes a free one.
        host: Address of this machine at which the page is served.
        allow_commands: Let the page stop the rig and command the daemon. The printed address
            contains the key that commands need.
        allow_remote: Serve the page to other machines; whoever reaches it can read it.
        security: Credentials file, if a rig or daemon requires authentication.
        folder: Folder of runs, in which a run is looked for by its name, and the run under way on
            a rig.
    """
    from estune.web.server import PageServer  # noqa: PLC0415  slow to import

    credentials = security_from(security)
    sources = [
        _views(one, rig, credentials, folder, is_one_of_several=len(what) > 1)
        for one in what or (api.RUNS,)
    ]
    server = PageServer(
        lambda: [view for views in sources for view in views()],
        host=host,
        port=port,
        may_command=allow_commands,
        allow_remote=allow_remote,
    )
    print(f"page at {server.address}", flush=True)
    try:
        threading.Event().wait()
    finally:
        server.close()


def _views(
    what: str, rig: str | None, security: Security, folder: Path, *, is_one_of_several: bool
) -> "Views":
    from estune.web import views  # noqa: PLC0415  slow to import

    if is_endpoint(what):
        found = _at_endpoint(what, rig, security, folder)
        for view in found if is_one_of_several else ():
            view.name = f"{view.name} at {what}"  # a run may have the name of a rig
        return lambda: found
    path = Path(what)
    if path.is_dir() and not (path / FILE_NAME).is_file():
        return views.folder_views(path, security)
    one = [views.run_view(find_run(what, folder), security)]
    return lambda: one


def _at_endpoint(endpoint: str, rig: str | None, security: Security, folder: Path) -> "list[View]":
    """The rigs that a daemon at the endpoint supervises, or those that are there themselves."""
    from estune.remote.zenoh import discover_rigs  # noqa: PLC0415  slow to import
    from estune.remote.zenoh.daemon_service import DaemonClient  # noqa: PLC0415  as above
    from estune.web import views  # noqa: PLC0415  as above

    there = {p.rig for p in discover_rigs(endpoint, security=security)}
    client = DaemonClient(endpoint, security=security)
    supervised = set(client.rigs())
    names = [name for name in sorted(there | supervised) if rig in (None, name)]
    if not names:
        client.close()
        which = f"rig {rig}" if rig else "rig or daemon"
        raise RigError(
            f"no {which} answers at {endpoint}; list the rigs: estune discover {endpoint}"
        )
    return [
        views.daemon_view(
            name,
            views.RemoteSupervision(client, name),
            target=endpoint if name in there else "",
            security=security,
        )
        if name in supervised
        else views.rig_view(endpoint, name, security, runs=folder)
        for name in names
    ]
