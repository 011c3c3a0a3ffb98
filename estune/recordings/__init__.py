"""Recorded data in the formats people have, as the columns of a record in SI units.

::

    file ──► readers/ ──► RawFile ──► column_map ──► timing ──► Recording
              CSV, Parquet, MATLAB,    names, units   even grid, parts
              ROS bags, MCAP, TDMS     and scales     between gaps
"""
