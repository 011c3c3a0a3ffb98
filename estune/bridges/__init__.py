"""A rig shown in ROS 2, PlotJuggler and Foxglove: read-only, each in a process of its own."""
