"""Rigs over Zenoh: `serve` makes one reachable, `connect` reaches it. Only here is Zenoh used."""

from estune.remote.zenoh.remote_rig import RemoteRig, connect, discover_rigs
from estune.remote.zenoh.rig_server import RigServer, serve

__all__ = ["RemoteRig", "RigServer", "connect", "discover_rigs", "serve"]
