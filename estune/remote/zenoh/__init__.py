"""Rigs over Zenoh: `serve` makes one reachable, `connect` reaches it. Only here is Zenoh used."""

from estune.remote.zenoh.remote_rig import RemoteRig, connect, discover_rigs
from estune.remote.zenoh.rig_server import RigServer, serve
from estune.remote.zenoh.setpoint_stream import SetpointStream

__all__ = ["RemoteRig", "RigServer", "SetpointStream", "connect", "discover_rigs", "serve"]
