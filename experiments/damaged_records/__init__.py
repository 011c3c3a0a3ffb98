"""Records of measured and simulated machines, damaged in the ways in which records are."""
