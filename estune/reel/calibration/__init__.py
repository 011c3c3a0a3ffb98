"""Calibration of the strain gauge (C2) and of the current controller (C1).

Both fit the reading to the setting: the gauge's counts to known forces, the motor's measured
current to commanded counts. As least squares assumes, the setting is exact and the reading is
noisy; fitted the other way round (a possible reading of the paper), noise would bend the curve.
The rig uses the exact inverse of the fitted curve, counts to force and current to counts, which is
checked to be monotone. Variables are scaled to -1..1 over the calibrated range, so that high
orders keep their digits.
"""

from estune.reel.calibration.current import CurrentCalibration
from estune.reel.calibration.gauge import GaugeCalibration
from estune.reel.calibration.monotone import Axis
from estune.reel.calibration.regression import LackOfFit, Regression

__all__ = ["Axis", "CurrentCalibration", "GaugeCalibration", "LackOfFit", "Regression"]
