"""Chaos test of the link, the daemon and the emergency stop.

`python -m experiments.chaos` runs tunings in a client process on a rig process. Meanwhile it cuts
and stalls the connections between them, kills and freezes both, sends commands twice, late and out
of order, starts second rigs and second clients, floods the rig and fills its disk and the
client's. Violations are counted from the rig's own log of its motions, from its ledger and from
the client's journal. Beside it a daemon that tunes repeatedly is killed, frozen, stopped,
disconnected and denied its disk; the gains that were ever live are counted from the rig's log.
Finally clients are killed and frozen during trials on the emulated hardware, and the time until
the reel is safe is measured.
"""
