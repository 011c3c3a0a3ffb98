"""Sweeps: one tuning for each cable length, tension, tuner, seed and rig, and the law over them.

`design` says what is asked for, `cells` what that comes to, `running` runs one, `outcome` is what
it came to, `store` keeps it; `runners`, `cluster` and `benches` run many; `result` is all of them
as frames, figures and laws.
"""
