"""The rule of a decision between fitted models, written out anew, and random fits to decide on.

Of fits, `left` is the power above the noise, and `best(fits)` the one that leaves the least.
"""

import math
from itertools import combinations

from plants.diagnosis.constants import CONSTANTS
from plants.diagnosis.result import ModelSummary
from plants.diagnosis.search.decide import Decision

FAMILIES = {"a": "f", "b": "f", "c": "c", "d": "d", "x": "x", "y": "y"}
NAMELESS = {"x", "y"}
NOTHING = frozenset[str]()


def random_fits(random):
    """A base model and fits of four effects, of two nameless laws, and of some pairs.

    Args:
        random: Python's own generator, the quickest for single CONSTANTS.
    """
    most = random.choice([1.0, 2.0, 10.0, 100.0, 1000.0])

    def power(names):
        explained = random.choice([0.3, 0.75, 0.9, 0.97, 0.999]) if names else 0.0
        return 0.8 + most * (1.0 - explained) * random.uniform(0.5, 1.0)

    def fit(names):
        slugs = frozenset(names)
        return ModelSummary(
            slugs,
            frozenset(FAMILIES[one] for one in slugs),
            random.randint(1, 2),
            power(names),
            random.randint(1, 3) + len(slugs) // 2,
            eligible=random.random() < 0.85,
            named=not slugs & NAMELESS,
            known_apart="d" in slugs and random.random() < 0.5,
        )

    names = [one for one in (*FAMILIES, *combinations("abcdx", 2)) if random.random() < 0.6]
    return ModelSummary(NOTHING, NOTHING, 0, power(()), 0), [fit(one) for one in names]


def left(fit):
    return max(fit.J, 1.0) - 1.0


def best(fits):
    return min(fits, key=lambda m: m.J, default=None)


def odds(base, fits):
    """p ~ (P + f (J0 - 1))^(-n/2) n^(-k/2), with powers relative to the least one's."""
    n = CONSTANTS.effective
    unit = min(1.0, base.J, *(m.J for m in fits))
    slack = CONSTANTS.form * left(base._replace(J=base.J / unit))
    weights = {
        m.names: (max(m.J / unit, 1.0) + slack) ** (-n / 2.0) * n ** (-m.values / 2.0)
        for m in (base, *fits)
    }
    return {names: weight / sum(weights.values()) for names, weight in weights.items()}


def decided(base, fits):
    """The decision, by the rules that `plants.diagnosis.search.decide` states."""
    if base.power <= CONSTANTS.nothing:
        return Decision("none", NOTHING)
    p = odds(base, fits)
    unit = min(1.0, base.J, *(m.J for m in fits))
    base, *fits = (m._replace(J=m.J / unit) for m in (base, *fits))
    named = [m for m in fits if m.named and m.eligible]
    laws = sorted((m for m in fits if not m.named and len(m.names) == 1), key=left)

    def share(fit):
        return 1.0 - left(fit) / left(base)

    chosen = believed(fits, p)
    if chosen is None:
        like = [next(iter(m.names)) for m in laws if share(m) >= CONSTANTS.named_share]
        leading = best([m for m in fits if m.named]) or base
        return Decision("unknown", NOTHING, (), like[0] if like else "", leading.names)
    rivals = [
        m
        for m in sorted(named, key=left)
        if len(m.names) <= len(chosen.names)
        and m.families.isdisjoint(chosen.families)
        and (m.known_apart, m.values) < (chosen.known_apart, chosen.values)
        and share(m) >= CONSTANTS.named_share
        and not takes_off(chosen, m, CONSTANTS.one_more)
    ]
    chosen = rivals[0] if rivals else chosen
    for law in laws:
        needed = {
            -1: not takes_off(chosen, law, CONSTANTS.one_more)
            or takes_off(law, chosen, CONSTANTS.one_more),
            0: takes_off(law, chosen, CONSTANTS.one_more),
            1: takes_off(law, chosen, CONSTANTS.named_share),
        }
        if needed[(law.values > chosen.values) - (law.values < chosen.values)]:
            return Decision("unknown", NOTHING, (), next(iter(law.names)), chosen.names)
    if chosen.power > CONSTANTS.floor and share(chosen) < CONSTANTS.named_share:
        return Decision("unknown", NOTHING, (), "", chosen.names)
    tied = tuple(
        m.names
        for m in sorted(named, key=left)
        if m.names != chosen.names
        and len(m.names) <= len(chosen.names)
        and not m.known_apart
        and (
            m.families.isdisjoint(chosen.families)
            or (m.families == chosen.families and (m.rank, m.values) == alike(chosen))
        )
        and p[m.names] / (p[m.names] + p[chosen.names]) > CONSTANTS.tied
    )
    verdict = "incomplete" if math.sqrt(chosen.power) > CONSTANTS.above_noise else "named"
    return Decision("ambiguous" if tied else verdict, chosen.names, tied, "", chosen.names)


def alike(fit):
    return fit.rank, fit.values


def takes_off(full, simple, share, least=0.0):
    """Whether one takes off so much of what another leaves, if that is above the noise."""
    missing = simple.power > max(CONSTANTS.floor, least)
    return missing and left(full) / left(simple) <= 1.0 - share


def best_named(fits):
    """The best single effect; the best pair where it takes off enough of what the best of that
    effect's families leaves, and something is missing there."""
    named = [m for m in fits if m.named and m.eligible]
    singles, pairs = ([m for m in named if len(m.names) == n] for n in (1, 2))
    if not singles or not pairs:
        return simplest(singles or pairs)
    fullest = best(singles)  # no other of its family leaves less
    if takes_off(best(pairs), fullest, CONSTANTS.one_more, CONSTANTS.nothing):
        return simplest(pairs)
    return simplest(singles)


def simplest(fits):
    """Of the families of the best fit the simplest that no fuller one takes much off."""
    if not fits:
        return None
    family = [m for m in fits if m.families == best(fits).families]
    kept = None
    for rank in sorted({m.rank for m in family}):
        of_rank = best([m for m in family if m.rank == rank])
        if kept is None or takes_off(of_rank, kept, CONSTANTS.one_more):
            kept = of_rank
    return kept


def believed(fits, p):
    """The best one, without a family that is rather not there, unless it explains the rest of what
    is incomplete without it."""
    chosen = best_named(fits)
    if chosen is None or len(chosen.families) == 1:
        return chosen
    there = {f: sum(p[m.names] for m in fits if f in m.families) for f in chosen.families}
    doubtful = min(there, key=there.__getitem__)
    if there[doubtful] >= 0.5:
        return chosen
    without = believed([m for m in fits if doubtful not in m.families], p)
    if without is None or not without.families < chosen.families:
        return without
    needed = takes_off(chosen, without, CONSTANTS.named_share, CONSTANTS.above_noise**2)
    return chosen if needed else without
