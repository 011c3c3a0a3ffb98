"""Prior of the cost of PIDF loops, fitted to random loops."""
