"""What the costs of PIDF loops have in common, from loops drawn at random."""
