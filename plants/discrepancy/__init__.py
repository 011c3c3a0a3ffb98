"""Where a simulation and measured records disagree, and which physical effect would explain it.

Records are read (`records`), looked through (`quality`) and given a noise floor (`floor`); the
residual of the base model is then localised (`where`) before any effect is fitted.
"""
