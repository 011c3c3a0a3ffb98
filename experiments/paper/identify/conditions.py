"""Lengths, tensions and excitation at which the reference reel is identified."""

from experiments.paper.identify.excitation import Band, BroadbandExcitation, multisine

LENGTHS_m = (0.5, 0.8, 1.1, 1.4)
TENSIONS_N = (5.0, 10.0, 20.0, 40.0)
SAMPLING_HZ = 632.0
BAND = Band(low_Hz=0.5, high_Hz=310.0, period_s=2.0, periods=4, settling_periods=1)
PEAK_N = 40.0


def excitation() -> BroadbandExcitation:
    """A multisine with most power above the resonance."""
    return multisine(SAMPLING_HZ, BAND, PEAK_N, slope=1.5, corner_Hz=20.0)
