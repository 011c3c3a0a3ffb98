"""`estune bridge`: a rig shown in ROS 2, PlotJuggler or Foxglove."""

import threading
from contextlib import ExitStack
from typing import Literal

from estune.cli.values import Flag, RigName, SecurityFile, security_from
from estune.core.quantities import check_positive
from estune.errors import InvalidInput
from estune.remote import zenoh
from estune.remote.zenoh.endpoints import check_endpoint

ROUTER = "tcp/127.0.0.1:7447"
"""Default address of the router of rmw_zenoh."""


def bridge(
    viewer: Literal["ros2", "plotjuggler", "foxglove"],
    endpoint: str,
    /,
    *,
    to: str | None = None,
    rig: RigName = None,
    domain: int = 0,
    dds: Flag = False,
    drum_radius_m: float | None = None,
    security: SecurityFile = None,
) -> None:
    """Show a rig in ROS 2, PlotJuggler or Foxglove, until Ctrl-C. Read-only: it commands nothing.

    Samples are sent while a trial runs, the status once a second.

    Args:
        viewer: Where the rig is shown.
        endpoint: Address of the rig, such as tcp/127.0.0.1:7448.
        to: Address of the viewer: of the Zenoh router of ROS (tcp/127.0.0.1:7447), or of the UDP
            server of PlotJuggler (127.0.0.1:9870). For Foxglove, where it is served
            (127.0.0.1:8765).
        domain: Domain id of ROS.
        dds: Send to DDS by zenoh-bridge-ros2dds, whose address --to is then.
        drum_radius_m: Drum radius, which turns the current into the joint's torque; without it the
            joint state has no effort.
    """
    if viewer != "ros2" and (domain or dds or drum_radius_m is not None):
        raise InvalidInput("--domain, --dds and --drum-radius-m are of ros2; leave them out")
    if drum_radius_m is not None:
        check_positive("drum_radius_m", drum_radius_m, "m")
    with ExitStack() as opened:
        the_rig = opened.enter_context(
            zenoh.connect(endpoint, rig=rig, security=security_from(security))
        )
        from estune.bridges import foxglove, plotjuggler  # noqa: PLC0415  needed only here
        from estune.bridges.ros2 import Ros2Viewer  # noqa: PLC0415  as above
        from estune.bridges.viewer import Viewer, follow  # noqa: PLC0415  as above
        from estune.remote.zenoh.put_session import PutSession  # noqa: PLC0415  as above

        shown: Viewer
        if viewer == "ros2":
            check_endpoint(to := to or ROUTER)
            remedy = "the router of ROS: ros2 run rmw_zenoh_cpp rmw_zenohd"
            put = opened.enter_context(PutSession(to, remedy))
            about = the_rig.describe()
            shown = Ros2Viewer(put, about, domain=domain, dds=dds, drum_radius_m=drum_radius_m)
        elif viewer == "foxglove":
            server = foxglove.FoxgloveViewer(the_rig.name, to or foxglove.ADDRESS)
            shown, to = opened.enter_context(server), f"ws://{server.address}"
        else:
            to = to or plotjuggler.ADDRESS
            shown = opened.enter_context(plotjuggler.PlotJuggler(the_rig.name, to))
        batches = opened.enter_context(the_rig.watch())
        print(f"rig {the_rig.name} shown in {viewer} at {to}; stop with Ctrl-C", flush=True)
        follow(the_rig, batches, shown, threading.Event())
