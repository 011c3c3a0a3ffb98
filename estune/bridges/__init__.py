"""A rig shown in other programs: ROS 2 and PlotJuggler. Read-only, a process of its own each."""
