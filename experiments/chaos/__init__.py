"""Does the link keep its promises while everything around it fails?

`python -m experiments.chaos` runs tunings in a client process of their own on a rig process of its
own, and meanwhile cuts and stalls the wires between them, kills and freezes both, sends commands
twice, late and out of order, starts second rigs and second clients, floods the rig and fills its
disk and the client's. What is promised is then counted from the rig's own log of its motions, from
its ledger and from the client's journal. The same faults meet a plain get that is asked again
where no answer came. A daemon that tunes again and again is killed, frozen, stopped, cut off and
denied its disk; which gains were ever live is counted from the rig's log. Then clients are killed
and frozen in the middle of trials on the emulated hardware, and the time is taken until the reel
is safe.
"""
