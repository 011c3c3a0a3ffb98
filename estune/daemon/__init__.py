"""The daemon: tunes rigs for days, keeps what was accepted, and notices when it no longer holds.

`life` says as a table what one rig's supervision does with each event, `store` keeps it on disk,
`keeper` carries it out, and `service` runs the keepers of several rigs in one process.
"""
