"""Identification of the physical effect that a model lacks, from measured records.

The theory of operation is docs/explanation/how-explain-works.md.

`explain` is the one call, `improve` the loop closed on a live rig. Below them, from a user's view
down: `report`, how a diagnosis is shown; `search`, which effect; `experiments`, what to measure;
`result`, the diagnosis as values; `residual`, where; `prediction`, `models`, `checks` and `data`.
"""
