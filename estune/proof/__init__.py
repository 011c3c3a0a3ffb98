"""A remedy as a patch of a rig's file, its proof on the rig, and its gain in service."""
