"""The daemon's live page: a view of each rig."""

from collections.abc import Mapping
from typing import TYPE_CHECKING

from estune.daemon.config import DaemonConfig
from estune.daemon.store import RUNS
from estune.daemon.supervised_rig import SupervisedRig
from estune.remote.security import Security

if TYPE_CHECKING:
    from estune.web.server import PageServer


def serve_page(
    config: DaemonConfig, supervised: Mapping[str, SupervisedRig], security: Security
) -> "PageServer":
    """Serves the page of the daemon's file.

    Raises:
        InvalidInput: the port is taken.
    """
    from estune.web.run_folder import RunFolder  # noqa: PLC0415  slow to import
    from estune.web.server import PageServer  # noqa: PLC0415  as above
    from estune.web.views import daemon_view  # noqa: PLC0415  as above

    views = [
        daemon_view(
            rig.name,
            supervised[rig.name],
            target=rig.target,
            runs=RunFolder(config.state / rig.name / RUNS),
            security=security,
        )
        for rig in config.rig
    ]
    return PageServer(lambda: views, port=config.page.http_port or 0, right=config.page.right)
