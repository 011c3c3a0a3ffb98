"""The paper's bench: reels measured on their own, face to face, and around one platform.

Nothing outside this wing needs it but the commands `estune bench` and
`python -m plants.bench.cable_platform`, and `plants.simulate_moving`. Its rooms, with the paper's
equations and figures:

    identify          resonance, damping and dead time of a reel from broadband records, (30);
                      its friction from a velocity ramp, (10)
    two_reels         eyelet angles (11)-(13), friction contact (14)-(20), attenuation ratio B and
                      friction coefficient (21)-(26), transparency index (27)-(29), hysteresis,
                      and the force felt at the cable while its far end moves
    cable_platform    reels that hold one body: tension distribution, pose control, real time
    demonstrations    friction and inertia compensation (Figs. 16 and 17), the boundary of the
                      workspace (Fig. 18), trials while the cable's end moves

`experiments/paper` compares their figures with the printed ones; docs/how-to/bench.md measures on
a real bench.
"""
