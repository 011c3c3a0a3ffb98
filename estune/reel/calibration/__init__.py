"""Calibration of the strain gauge (C2) and of the current controller (C1).

Both fit what was read to what was set by hand: the gauge's counts to known forces, the motor's
measured current to commanded counts. The setting is exact and can be repeated, the reading carries
the noise, and that is what least squares assumes; fitted the other way round (as the paper's text
may be taken), the noise would bend the curve and repeats would test nothing. What the rig needs,
counts to force and current to counts, is the exact inverse of the fitted curve, which is checked
to be monotone. Variables are scaled to -1..1 over the calibrated range, so that high orders keep
their digits.
"""

from estune.reel.calibration.current import CurrentCalibration
from estune.reel.calibration.gauge import GaugeCalibration
from estune.reel.calibration.monotone import Axis
from estune.reel.calibration.regression import LackOfFit, Regression

__all__ = ["Axis", "CurrentCalibration", "GaugeCalibration", "LackOfFit", "Regression"]
