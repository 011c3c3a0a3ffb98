"""The daemon: tunes rigs, watches the accepted gains for days, and tunes again after a drift.

`supervisor_state` is the state machine of one rig, `store` keeps its state on disk, `supervisor`
executes it, and `service` runs the supervisors of several rigs in one process.
"""
