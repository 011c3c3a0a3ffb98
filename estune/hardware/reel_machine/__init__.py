"""State machine of the reel at each sample: guard, phase, controller; no clock, no hardware.

::

    OFF ──begin──► TAKE_UP ──taut──► HOLD ──settled at the preload──► TRIAL ──► HOLD
                      │                │  ◄──── guard, safe state "hold" ───┤
                      └──── guard ─────┴──────────────► RAMP ◄──── guard ───┘
                                                          └──► STOPPED ──begin──► TAKE_UP

`transitions.TABLE` has what each event does in each phase. What the guard finds at a sample
decides the current commanded at that same sample. A stop caused by a trial's gains, or by a
stalled computer, ends with the next trial. Any other is latched: the rig takes no trial until an
operator has cleared it.
"""
