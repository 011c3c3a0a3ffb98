"""A remedy as a patch of a rig's file, and its proof on the rig: trials with it and without."""
