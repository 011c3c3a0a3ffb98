"""Where a simulation and measured records disagree, and which physical effect would explain it.

`explain` is the one call, `improve` the loop closed on a live rig. Below them, from a user's view
down: `experiments`, what to measure; `search`, which effect; `report`, what is said; `residual`,
where; `prediction`, `models`, `checks` and `data`, what it all stands on.
"""
