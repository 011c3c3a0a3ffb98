"""Rigs over Zenoh: `serve` makes one reachable, `connect` reaches it. Only here is Zenoh used."""

from estune.bus.client import RemoteRig
from estune.bus.finding import connect, find
from estune.bus.server import RigServer, serve

__all__ = ["RemoteRig", "RigServer", "connect", "find", "serve"]
