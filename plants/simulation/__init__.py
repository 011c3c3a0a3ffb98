"""Simulated trials: compiled loop, batches, a plant as a rig.

**Guarantees.** The noise of a trial is a function of the rig's seed and the trial's number, so
that a resumed run sees what the uninterrupted one would have. A batch gives each trial the numbers
that it has alone, on any number of threads. Without a C compiler all results are the same, only
later.

**Theory of operation.** A plant is written once, as CasADi expressions of one sample
(`equations`): `prepare` once a trial, for all that depends on the parameters alone, such as the
matrix exponential; `sense`, the reading and the controller; `substep`, the state a quarter of a
sample later. The same functions are differentiated by the diagnosis and exported. `c_source`
prints them as C beside the hand-written loop of `trial_loop.c`, compiled once for each structure:
numbers are arguments, so that new parameters need no compiler. The dead time is a ring of past
drives and a change of the drive within a sample. Rows of parameters run together in the lanes of a
vector register (`vector_code`).

**Choices that are not obvious.** The linear part is propagated exactly and only the nonlinear
forces are held or solved in a substep: the error of an integrator would otherwise look like dead
time or like a mode of the gauge. Dry friction is a proximal step, the torque that would stop the
drum or the greatest there is: it neither chatters nor needs smoothing. Generated outputs are made
dense, as CasADi writes sparse ones in another order, and the functions have names of their own:
one called `step` would bind to the C library's and hang.

**Tried and lost.** For a trial of 632 samples of the reel with gauge mode, friction and dead time,
against hand-written C: this loop takes 1.26 times as long, CasADi's own `mapaccum` 2.5 times (it
copies the constants at every step), its virtual machine 18 times through buffers and 26 times
through plain calls. `python -m experiments.benchmark_trials` measures today's ratios of the first
and the third.
"""
