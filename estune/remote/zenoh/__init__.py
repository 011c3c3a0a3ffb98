"""Rigs over Zenoh: `serve` makes one reachable, `connect` reaches it. Only here is Zenoh used.

**Guarantees.** A trial runs at most once, whatever is cut, killed, delayed or repeated; its record
is not lost while the rig's disk lives; a rig whose client is gone returns to its live gains within
the lease of 1 s; an emergency stop waits for no other command.

**Theory of operation.** A Zenoh query is no remote procedure call. An empty reply comes from a rig
that is absent, crashed, cut off, restarting or forbidden to this user, and from one that ran the
trial and lost its reply. So an empty reply never means "did not run", and nothing here repeats a
command because it went unanswered. Instead every trial has an id, and the rig a ledger on disk::

    client                                      rig
      lease   ──────────────────────────────►  one owner, for 1 s at a time
      submit (id, digest, lease)  ───────────►  ledger: accepted, then running, then motion
      poll result/<id>            ◄──────────►  ledger: unknown | running | the record
                                                unknown is the only answer after which the client
                                                submits again

`estune.remote.state_machine` decides both sides as pure functions; this package carries out what
they decide. `rig_connection` has the client's queries, `trial_exchange` a trial on the client's
side, `request_handler` and `trial_execution` the rig's, `client_lease` the renewal.

**Choices that are not obvious.** Results are polled and not awaited in the query: a query of
Zenoh's is lost with its connection, and a handler that runs a trial would block its entity's
queue. Commands stand under a chunk that begins with `@`, which no wildcard matches, so that a
query for everything reaches no motor. Each boot of a rig has an instance id in its keys, so that a
command for the last boot cannot arrive at this one. The rig's state lock is never held during a
write to disk or a motion. Queries wait in lines of our own (`Lane`): a handler's `recv` of Zenoh's
wakes some twenty times a second to look for signals, which at 100 rigs kept the daemon from
renewing its leases. Liveliness is not used as health: its signals come from Zenoh's own threads
and go on while Python hangs, which is why clients renew a lease.

**Tried and lost.** "Query, and repeat on an empty reply" ran 31 of 65 trials more than once under
62 injected faults; this protocol ran none twice (`python -m experiments.chaos`). Shared memory
gained nothing up to 80 kB and left files behind killed processes. Other encodings of a record
(MessagePack, Arrow, CDR) accepted damaged frames as wrong data in more than a third of 1500
mutations, for want of a checksum; the frame of `estune.trial.record_frame` accepted none.
"""

from estune.remote.zenoh.discovery import connect, discover_rigs
from estune.remote.zenoh.remote_rig import RemoteRig
from estune.remote.zenoh.rig_server import RigServer, serve
from estune.remote.zenoh.setpoint_stream import SetpointStream

__all__ = ["RemoteRig", "RigServer", "SetpointStream", "connect", "discover_rigs", "serve"]
