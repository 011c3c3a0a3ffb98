"""Fig. 17: what is fed forward while the platform hardly moves?"""

import numpy as np

from experiments.paper import PaperFigure, show
from experiments.paper.compensation import active_share, deviation, draw, rms, uncompensated
from plants.demonstrations.friction_compensation import reference_wrench_trial, run_high_and_low

LOW_SHARE = 0.1


def make(*, quick: bool = False) -> PaperFigure:  # noqa: ARG001  one run is quick enough
    """The figure."""
    trial = reference_wrench_trial()
    high, low = run_high_and_low(trial, LOW_SHARE)
    _, bare = run_high_and_low(uncompensated(trial), LOW_SHARE)
    reel = trial.platform.reel
    floor = trial.windows.acceleration_floor_rad_s2(reel.sampling_Hz)
    floor_N = trial.feed_forward.inertia_kgm2 * floor / reel.drum_radius_m
    share, share_high = active_share(low), active_share(high)
    inertia = rms(low.true_inertia_N)
    fed = float(np.abs(low.friction_N).max())
    with_it, without = deviation(low, trial), deviation(bare, trial)
    return PaperFigure(
        number=17,
        title="Force feed-forward compensation with low angular velocity",
        claim="At low speed a low-resolution encoder makes the computation of inertia nearly "
        "impossible, so it is compensated only above its noise floor.",
        holds=share == 0.0 and share_high > 0.0 and inertia < floor_N and fed > 0.0,
        measured=f"The noise floor of {floor:.1f} rad/s² is {floor_N:.2f} N at the cable; the "
        f"true inertia is {inertia:.2f} N rms, and is compensated in {100.0 * share:.0f} % of the "
        f"samples, against {100.0 * share_high:.0f} % in Fig. 16. Friction is still compensated, "
        f"by up to {fed:.2f} N. The tension strays {with_it:.3f} N rms from its setpoint, "
        f"{without:.3f} N with nothing fed forward.",
        rule="The inertia, rms, lies below the noise floor and is never compensated, "
        "while friction is, and at high speed inertia is too.",
        caveat=f"The trial of Fig. 16 with a wrench of {LOW_SHARE * trial.wrench_N:g} N. The "
        "floor is that of full windows of the velocity estimator; at this speed the drum sticks "
        "and slips, and compensation changes the tension little.",
        numbers={
            "floor_rad_s2": floor,
            "floor_N": floor_N,
            "inertia_N": inertia,
            "inertia_active_share": share,
            "inertia_active_share_high": share_high,
            "friction_fed_N": fed,
            "tension_deviation_N": with_it,
            "tension_deviation_bare_N": without,
        },
        figure=draw(low, trial),
    )


if __name__ == "__main__":
    show(make())
