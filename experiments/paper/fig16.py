"""Fig. 16: what is fed forward while the platform moves far and fast?"""

from experiments.paper import PaperFigure, show
from experiments.paper.compensation import (
    active_share,
    deviation,
    draw,
    rms,
    uncompensated,
    weight_N,
)
from plants.demonstrations.friction_compensation import reference_wrench_trial, run_high_and_low


def make(*, quick: bool = False) -> PaperFigure:  # noqa: ARG001  one run is quick enough
    """The figure."""
    trial = reference_wrench_trial()
    high, _ = run_high_and_low(trial)
    bare, _ = run_high_and_low(uncompensated(trial))
    inertia, friction = rms(high.true_inertia_N), rms(high.true_friction_N)
    inertia_left = rms(high.true_inertia_N - high.inertia_N)
    friction_left = rms(high.true_friction_N - high.friction_N)
    share = active_share(high)
    with_it, without = deviation(high, trial), deviation(bare, trial)
    weight = float(weight_N(trial, high.position_m).max())
    return PaperFigure(
        number=16,
        title="Force feed-forward compensation with high angular velocity",
        claim="Under a sinusoidal wrench of high amplitude each component of the feed-forward is "
        "at work: the motor's inertia, friction, and the cable's weight.",
        holds=share > 0.5 and inertia_left < 0.5 * inertia and friction_left < 0.5 * friction,
        measured=f"Inertia is compensated in {100.0 * share:.0f} % of the samples and leaves "
        f"{inertia_left:.2f} of {inertia:.2f} N rms, friction {friction_left:.2f} of "
        f"{friction:.2f} N rms; the cable's weight is never more than {weight:.3f} N. The tension "
        f"strays {with_it:.2f} N rms from its setpoint, {without:.2f} N with nothing fed forward.",
        rule="Inertia is compensated more than half of the time, and less than half of inertia "
        "and of friction is left, rms.",
        caveat=f"A wrench of {trial.wrench_N:g} N at {trial.wrench_Hz:g} Hz on a simulated "
        f"platform; an encoder of {trial.platform.reel.encoder_counts:.0f} counts a turn, the "
        f"paper's. {100.0 * trial.feed_forward.fraction:g} % of the friction is compensated, so "
        "that an error in its coefficients cannot drive the drum. The weight, of a cable that "
        "hangs straight down, is drawn for its size and is not fed forward here.",
        numbers={
            "inertia_active_share": share,
            "inertia_N": inertia,
            "inertia_left_N": inertia_left,
            "friction_N": friction,
            "friction_left_N": friction_left,
            "weight_N": weight,
            "tension_deviation_N": with_it,
            "tension_deviation_bare_N": without,
        },
        figure=draw(high, trial),
    )


if __name__ == "__main__":
    show(make())
