"""Sweeps: one tuning for each cable length, tension, tuner, seed and rig, and the law over them.

`design` says what is asked for, and `cells` what that comes to. `running` runs a `cell`, `outcome`
is what became of it, and `store` keeps that; `runners`, `cluster` and `benches` run many. `result`
is all of them, as frames, figures and laws.
"""
