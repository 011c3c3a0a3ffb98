"""Identification of the physical effect that a model lacks, from measured records.

`explain` is a pipeline of eight steps. Each is a function in a file of its name in `pipeline`,
from the frozen values of the steps before it to one of its own; no step goes back.

    read       files or records            -> measurements on even clocks, in SI units
    check      measurements                -> those that can be used, and why others cannot
    noise      measurements                -> the noise of each sensor: the unit of all errors
    fit        model, noise                -> the base model fitted, and where its error is
    screen     base fit                    -> the share of the error that each direction explains
    compare    base fit, directions        -> models with effects, the one believed, its verdict
    intervals  the model believed          -> 95 % intervals of its numbers
    report     all of it                   -> the diagnosis in words, in the plant's own units

What each step assumes, and why: docs/explanation/diagnosis.md.

Rooms from a user's view down: `pipeline`; `report`, how a diagnosis is shown; `search`, the parts
of screen, compare and intervals; `experiments`, what to measure next; `result`, the diagnosis as
values; `residual`, where the error is; `prediction`, `models`, `checks` and `data`.
"""
