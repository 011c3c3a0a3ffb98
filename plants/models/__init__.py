"""Plant models: reels, linear systems, Python functions, model files.

**Guarantees.** A model is a frozen value whose fields have their unit in the name; `model +
effect` is a new one. Every model can be simulated and served as a rig; those with equations can be
differentiated, so that a diagnosis can fit them. A model of a kind in `model_tables` that is saved
and loaded is equal.

**Theory of operation.** Effects sit along the signal's own path, each a stage with states of its
own (`effect_stages`)::

    command ─► actuator ─► torque ─► drum ─► angle ─► cable ─► eyelet ─► tension ─► gauge
                                                └──► encoder

`path_structure` makes the equations of one sample from a `SignalPath`, of which there are two.
`reel_signal_path` is the reel of `reel_equations`, with an eyelet, slack and a gauge that has a
mode of its own. `linear_signal_path` gives any linear plant the ports of a reel: the deviation of
a cable's law from the plant's own restoring force is fed back into its input
(`linear_with_effects`), in units scaled to the plant. A Python function is traced with symbols
where that is possible (`symbolic_plant`) and else run sample by sample (`python_plant`); an FMU
runs in a process of its own (`fmu`).

**Choices that are not obvious.** The two paths are not one. A linear plant is known by its input
and its output alone; the reel's effects act on the tension before the gauge's mode, and its cable
cannot push, which the form of the linear plant cannot express without a second output. What they
share, propagation, dead time, stages and the state at rest, stands once in `path_structure` and
`effect_stages`. A linear plant with effects is held by gain, modes and time constants
(`pole_zero_form`) and not by polynomials, so that each number has a physical meaning and a fit
cannot change the excess of poles over zeros. The tension at low preload is that of a softer cable,
the sag's share (Ernst 1965), in the linear law itself.

**Tried and lost.** The reel as differential equations under a general solver (python-control's
`input_output_response`) takes more than 1000 times as long as this form.
"""
