"""Many tunings: sweeps, matched reels, gain laws."""
