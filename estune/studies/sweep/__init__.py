"""Sweeps: one tuning for each cable length, tension, tuner, seed and rig, and the law over them.

`design` is the input, `cells` its expansion into single tunings, `executors` and `rig_workers` run
them, each `outcome` is committed to the `store`, and `result` and `report` present all of them.
"""
