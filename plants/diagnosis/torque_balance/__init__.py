"""The judge of the torque balance: laws of a drive that act as a torque."""
