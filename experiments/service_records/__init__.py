"""Records of ordinary service, simulated, and what `suggest` reads in them."""
