"""How fast is a sweep: on one core, on two, on a Dask cluster, and compared with python-control?

80 000 search trials of 400 tunings, at 10 lengths, 4 tensions and 10 seeds, run once on two cores
and once on one. Every tuning uses all of its 200 trials. The time is from the call to the last
cell on disk. For comparison, the same loop of tuner, session and cost runs some trials of one
tuning simulated by python-control's `input_output_response`; its process time is scaled to the
same number. The overhead of an executor is its time, times its processes, less the time of the
cells, per cell; for processes and for a Dask scheduler with workers on loopback, both warm. The
memory of a worker is its peak, as reported by the system.
"""
