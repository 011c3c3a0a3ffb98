"""Pure state machines of the rig protocol: no transport, clock or disk.

`trials` holds the states of one trial id in a rig's ledger, `rig` the reaction of a rig to each
command, `client` the reaction of a client to each reply. Each is a table of state by event, which
`estune.remote.zenoh` and `estune.remote.ledger` execute.
"""
