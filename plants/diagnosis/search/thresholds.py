"""What counts as a gap, as closed, and as large enough to name: every threshold, with its reason.

Gaps are in floors: the root mean square of residuals that were divided by noise and allowance.
"""

from collections.abc import Mapping

from plants.effects import Effect, RecordScale

GAP = 1.5
"""A model as given has something to explain from this gap on."""
NOTHING = 1.25
"""Up to this gap there is nothing that has to be named: twice the power that the floor has room
for comes from how well the floor itself is known."""
CLOSED = 1.15
"""Gap from which on down nothing worth adding is left."""
CLOSURE = 0.75
"""Share of the power above the floor that a name has to close; what closes less has another
cause."""
DONE = 0.9
"""Share closed from which on no other effect is tried that its direction does not suggest."""
CLOSURE_OF_MUCH = 0.85
"""The same where more is left than a gap to explain: what acts in another way may close as much
as three quarters."""
FIRST = 0.4
"""Share of the power above the floor that the first effect has to close: another may close the
rest."""
FURTHER = 0.5
"""Share of the power that is left which one more effect has to close."""
LITTLE = 0.05
"""Share of the first gap's power up to which what is left may be that the law named is not quite
the machine's; one more effect then has to close as much of it as a name takes, or to stand out. As
much it has to close where much is left after it, or where what is left is no gap: then nothing
tells that it is the one."""
SECOND = 0.4
"""Share of what one more effect closes up to which all others have to stay for it to stand out:
what a law leaves that is not quite the machine's has no shape of its own, and several take some
off. Where a second effect is there, of another law the others close a third of what it does, or
less."""
NARROW = 0.1
"""Share of all the power, the floor's too, that a mode has to take off on the fit and the rank
split where no gap is left beside it. Four values take off a thousandth of what has no shape;
where no mode is there the best direction of one explains no more than two hundredths, and half
of this is asked of a direction before it is fitted."""
INCOMPLETE = 3.0
"""Gap that a named effect may leave before it is said to be incomplete."""
SIMPLER = 1.08
"""Ratio of powers left, on the fit and the rank split, up to which the simpler member of a family
is kept: what a law that is not quite the machine's lets one more parameter take off."""
WELL = 0.95
"""Share closed from which a member of a family that shows in its own right is not given up for
one that does more: no machine's law is quite the model's."""
ALIKE = 1.5
"""Two models are alike that leave powers whose ratio is no larger, or the floor."""
BEATEN = 1.3
"""Ratio of powers left, on the fit and the rank split, below which a law without a name shows that
the one named is not what is there."""
TIE = 0.1
"""Difference of closure below which two effects may be told apart only by significance."""
LIKELIER = 1.64
"""Standard errors from which on one of two laws is likelier that are both plausible: nineteen
times in twenty chance makes less."""
SIGNIFICANT = 3.0
"""Standard errors, over blocks of time, by which one model has to be better than another."""
SIGNIFICANT_GAIN = 60.0
"""Squares of the rank split, in floors squared, that an effect has to take off. Where it does
nothing it takes off about one for each parameter; residuals that are coloured as a plant's
response is make that some ten, and it is the best of twenty."""
DISTORTED = 4.0
"""From this gap on the base fit's calibrations may have bent far to make up for what is missing;
directions are then looked for from the model as given, too."""
NEAR = 4.0
"""Ratio of powers left by the model as given and by the base fit up to which the former is near
enough to look from it alone."""
SHOWN = 0.3
"""Least change, in floors, that an effect of usual size has to make, or records cannot show it."""

AS_GOOD = 1.1
"""One calibration explains all where the power it leaves is no more than so many times what all
of them together leave."""

STUCK = 0.9
"""Ratio of powers left from which on down a fit that goes on had been stuck."""

SHORTLIST = 5
"""Effects fitted jointly in the first round, by their direction."""
SHORTLIST_FURTHER = 5
"""The same in later rounds."""
LEADING = 2
"""Families of effects that a second one is tried with where none is worth adding alone."""
DEEPEST = 3
"""Most effects added."""

RECKONED = 0.1
"""Share to which inertia and friction are known that were reckoned from drawings."""


def large_enough(
    effect: type[Effect], values: Mapping[str, float], scale: RecordScale, *, told: bool = False
) -> bool:
    """Whether an effect is of a size that matters in practice; see `Effect.matters`."""
    own = {name: values[f"{effect.name}.{name}"] for name in effect.parameters()}
    return effect.matters(own, scale, distinct=told)
