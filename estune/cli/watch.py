"""`estune watch`: the live page of a run, a folder of runs, a rig or a daemon."""

import threading
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING

from estune.cli.runs import find_run
from estune.cli.values import Flag, RunName, security_from
from estune.errors import RigError
from estune.remote.messages.rights import Right
from estune.remote.security import Security
from estune.remote.zenoh.endpoints import check_endpoint
from estune.run.journal import FILE_NAME, RUNS
from estune.run.targets import is_endpoint

if TYPE_CHECKING:
    from estune.web.run_folder import RunFolder
    from estune.web.views import Views

PORT = 8765


def watch(
    *what: RunName,
    rig: str | None = None,
    port: int | None = None,
    host: str = "127.0.0.1",
    allow_commands: Flag = False,
    allow_stop: Flag = False,
    allow_remote: Flag = False,
    security: Path | None = None,
    folder: Path = Path(RUNS),
) -> None:
    """Show runs, rigs and daemons live on a page in the browser.

    The page shows; it commands nothing unless started with --allow-commands. It cannot slow or
    stop a run.

    Args:
        what: A run (its name, or its folder), a folder of runs, or the endpoint of rigs or of a
            daemon; several are on one page. By default all rigs and daemons that you run on this
            machine, and the runs of --folder.
        rig: Name of one rig at the endpoint; all of them by default.
        port: Port of the page; by default 8765, or a free one where that is taken.
        host: Address of this machine at which the page is served.
        allow_commands: Let the page stop the rig and command the daemon. The printed address
            contains the key that commands need.
        allow_stop: Let the page stop the rig, and nothing else; with such a key.
        allow_remote: Serve the page to other machines; whoever reaches it can read it.
        security: Credentials file, if a rig or daemon requires authentication.
        folder: Folder of runs: those that are shown by default and of the rigs, and in which a run
            is looked for by its name.
    """
    from estune.web.http_service import usual_port  # noqa: PLC0415  slow to import
    from estune.web.run_folder import RunFolder  # noqa: PLC0415  as above
    from estune.web.server import PageServer  # noqa: PLC0415  as above
    from estune.web.views import folder_views  # noqa: PLC0415  as above

    stop = Right.STOP if allow_stop else Right.LOOK
    right = Right.COMMAND if allow_commands else stop
    credentials, runs = security_from(security), RunFolder(folder)
    with ExitStack() as ends:
        alone = len(what) == 1
        sources = [_source(one, rig, credentials, runs, ends, alone=alone) for one in what]
        if not what:
            sources.append(_all_here(credentials, rig, runs, ends))
        listed = any(Path(one).resolve() == folder.resolve() for one in what)
        if not listed and (not what or any(map(is_endpoint, what))):  # they stand below their rig
            sources.append(folder_views(runs, credentials))
        server = PageServer(
            lambda: [view for views in sources for view in views()],
            host=host,
            port=usual_port(PORT, host) if port is None else port,
            right=right,
            allow_remote=allow_remote,
        )
        ends.callback(server.close)
        print(f"page at {server.address}", flush=True)
        threading.Event().wait()


def _source(
    what: str,
    rig: str | None,
    security: Security,
    runs: "RunFolder",
    ends: ExitStack,
    *,
    alone: bool,
) -> "Views":
    from estune.web import views  # noqa: PLC0415  slow to import
    from estune.web.run_folder import RunFolder  # noqa: PLC0415  as above

    if is_endpoint(what):
        return _at_endpoint(what, rig, security, runs, ends, alone=alone)
    path = Path(what)
    if path.is_dir() and not (path / FILE_NAME).is_file():
        return views.folder_views(RunFolder(path), security)
    one = [views.run_view(find_run(what, runs.path), security)]
    return lambda: one


def _all_here(security: Security, rig: str | None, runs: "RunFolder", ends: ExitStack) -> "Views":
    """All rigs and daemons of this user on this machine."""
    from estune.remote.zenoh.local_endpoints import local_endpoints  # noqa: PLC0415  slow to import
    from estune.web.endpoint_views import EndpointViews  # noqa: PLC0415  as above

    here = EndpointViews(local_endpoints, security, runs=runs, rig=rig)
    ends.callback(here.close)
    here.read()
    return here


def _at_endpoint(
    endpoint: str,
    rig: str | None,
    security: Security,
    runs: "RunFolder",
    ends: ExitStack,
    *,
    alone: bool,
) -> "Views":
    """The rigs that a daemon at the endpoint supervises, and those that are there themselves."""
    from estune.web.endpoint_views import EndpointViews  # noqa: PLC0415  slow to import

    check_endpoint(endpoint)
    there = EndpointViews(lambda: (endpoint,), security, runs=runs, rig=rig, named_alone=alone)
    ends.callback(there.close)
    there.read()
    found = there()
    if not any(view.commands for view in found):
        which = f"rig {rig}" if rig else "rig or daemon"
        nobody = f"no {which} answers at {endpoint}; list the rigs: estune discover {endpoint}"
        raise RigError(next((view.board.get("fault.rig") for view in found), nobody))
    return there
