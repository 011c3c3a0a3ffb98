"""Who may do what on a link, and when: state machines with no transport, clock or disk in them.

`trials` is the life of one trial id in a rig's ledger, `rig` what a rig does with each command,
`client` what a client does with each answer. Each is a table of state by event; `estune.remote.zenoh` and
`estune.remote.ledger` are thin layers over them.
"""
