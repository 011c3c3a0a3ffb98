"""How fast is a sweep: on one core, on two, on a Dask cluster, and beside python-control?

80 000 search trials are run, of 400 tunings at 10 lengths, 4 tensions and 10 seeds that each use
all of their 200 trials, once on two cores and once on one, from the call to the last cell on disk.
The same loop of tuner, session and cost around a trial simulated by python-control's
`input_output_response` runs for some trials of one tuning; its time, which is what its process
computed whoever else had the core, is scaled to as many. What starting a cell costs is a runner's
time, times its processes, less the time the cells themselves took, per cell: for processes here,
and for a Dask scheduler with separate worker processes on loopback, both warm. The memory of a
worker is the most it ever held, told by the system.
"""
