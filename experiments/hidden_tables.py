"""Rates and tables of diagnosed cases with hidden effects."""

import math
from collections import Counter
from collections.abc import Callable, Sequence
from itertools import pairwise
from statistics import median
from typing import NamedTuple

from experiments.hidden_scores import Held, Row

BINS = (0.0, 0.05, 0.2, 0.5, 0.8, 0.95, 1.0)
"""Edges of the probabilities whose frequencies are compared."""

SINGLE = ("plain", "steps_only", "wrong_base", "unloaded", "stage")
NOTHING = ("none", "none_unloaded")
OUTSIDE = ("outside", "outside_unloaded", "left_out")


def confusion(rows: list[Row]) -> dict[str, dict[str, int]]:
    """Counts of answers by hidden effect; of one hidden effect or none."""
    table: dict[str, Counter[str]] = {}
    for row in rows:
        if row.variant in ("two", "left_out"):
            continue
        said = "+".join(row.found) if row.found else row.verdict
        if row.verdict in ("incomplete", "ambiguous") and row.found:
            said = f"{said} ({row.verdict})"
        truth = "+".join(row.truth) or "none"
        if row.truth and not row.visible:
            said = f"{said}, gap below 1.5"
        table.setdefault(truth, Counter())[said] += 1
    return {truth: dict(said.most_common()) for truth, said in sorted(table.items())}


def rate(rows: list[Row], holds: Callable[[Row], bool]) -> float:
    """Share of the rows for which it holds; nan without rows."""
    return sum(map(holds, rows)) / len(rows) if rows else math.nan


def middle(values: list[float]) -> float:
    """Median of what is finite."""
    finite = [value for value in values if math.isfinite(value)]
    return median(finite) if finite else math.nan


def of(rows: list[Row], *variants: str) -> list[Row]:
    """The rows of some variants."""
    return [row for row in rows if row.variant in variants]


def summary(rows: list[Row]) -> dict[str, float]:
    """The figures that are asked for, by name."""
    single = [row for row in of(rows, *SINGLE) if row.visible]
    plain = [row for row in of(rows, "plain") if row.visible]
    two = [row for row in of(rows, "two") if row.visible]
    both_visible = [row for row in two if row.each_visible]
    right = [row for row in single if row.right]
    held = [one.holds for row in rows if row.right for one in row.intervals]
    calibrated = [one.holds for row in rows if row.right for one in row.calibrations]
    return {
        "cases": float(len(rows)),
        "errors": float(sum(bool(row.error) for row in rows)),
        "single_visible": float(len(single)),
        "single_below_1.5_floors": float(len(of(rows, *SINGLE)) - len(single)),
        "exact_name": rate(single, lambda row: row.right),
        "right_family": rate(single, lambda row: row.right_family),
        "plain_exact_name": rate(plain, lambda row: row.right),
        **{
            f"{variant}_exact_name": rate(
                [row for row in of(rows, variant) if row.visible], lambda row: row.right
            )
            for variant in (*SINGLE[1:], "noise5", "no_encoder")
        },
        "incomplete_among_right": rate(right, lambda row: row.verdict == "incomplete"),
        "nothing_hidden": float(len(of(rows, *NOTHING))),
        "false_alarms": rate(of(rows, *NOTHING), lambda row: row.verdict != "none"),
        "no_encoder_false_alarms": rate(
            of(rows, "none_no_encoder"), lambda row: row.verdict != "none"
        ),
        "outside_misnamed": rate(of(rows, *OUTSIDE[:2]), lambda row: row.wrong_name),
        "left_out_misnamed": rate(of(rows, "left_out"), lambda row: row.wrong_name),
        "two_exact": rate(two, lambda row: row.right),
        "two_both_found": rate(two, lambda row: row.both_found),
        "two_each_visible_alone": float(len(both_visible)),
        "two_both_found_of_these": rate(both_visible, lambda row: row.both_found),
        "noise5_wrong_names": float(sum(row.wrong_name for row in of(rows, "noise5"))),
        "median_gap_closed": middle([row.gap_closed for row in right]),
        "median_free_run_ratio": middle([row.rms_ratio for row in right]),
        "intervals": float(len(held)),
        "intervals_hold_truth": sum(held) / len(held) if held else math.nan,
        "calibrations_hold_truth": sum(calibrated) / len(calibrated) if calibrated else math.nan,
        "calibration_error": calibration_error(reliability(rows)),
        "median_cpu_s": middle([row.cpu_s for row in rows]),
        "slowest_cpu_s": max((row.cpu_s for row in rows if not row.error), default=math.nan),
    }


def confidence(rows: list[Row]) -> dict[str, tuple[int, int, float, float]]:
    """Cases that count, of how many, and the 95 % confidence interval of their share.

    The interval is that of Clopper & Pearson (1934). Values of one machine are not independent:
    those of the values in intervals are a little too narrow.
    """
    from scipy.stats import binomtest  # noqa: PLC0415  slow to import

    single = [row for row in of(rows, *SINGLE) if row.visible]
    two = [row for row in of(rows, "two") if row.visible]
    right = [row for row in rows if row.right]
    kinds = {
        "exact_name": [row.right for row in single],
        "false_alarms": [row.verdict != "none" for row in of(rows, *NOTHING)],
        "outside_misnamed": [row.wrong_name for row in of(rows, *OUTSIDE[:2])],
        "left_out_misnamed": [row.wrong_name for row in of(rows, "left_out")],
        "two_both_found": [row.both_found for row in two],
        "two_both_found_of_visible": [row.both_found for row in two if row.each_visible],
        "intervals_hold_truth": [one.holds for row in right for one in row.intervals],
        "calibrations_hold_truth": [one.holds for row in right for one in row.calibrations],
    }
    found = {}
    for name, holds in kinds.items():
        if holds:
            low, high = binomtest(sum(holds), len(holds)).proportion_ci()
            found[name] = sum(holds), len(holds), float(low), float(high)
    return found


class Reliability(NamedTuple):
    """Probabilities stated between two edges, and how often the family was there."""

    stated: float
    there: float
    number: int


def reliability(rows: list[Row]) -> list[Reliability]:
    """Stated probabilities of families against their frequencies, bin by bin."""
    stated = [one for row in rows for one in row.stated if math.isfinite(one.probability)]
    found = []
    for low, high in pairwise(BINS):
        within = [s for s in stated if low <= s.probability < high or s.probability == high == 1.0]
        if within:
            mean = sum(s.probability for s in within) / len(within)
            there = sum(s.there for s in within) / len(within)
            found.append(Reliability(mean, there, len(within)))
    return found


def calibration_error(bins: list[Reliability]) -> float:
    """Expected calibration error: mean difference of probability and frequency."""
    number = sum(one.number for one in bins)
    return sum(abs(one.stated - one.there) * one.number for one in bins) / number if bins else 0.0


def show(rows: list[Row]) -> None:
    """Prints the tables."""
    print("stated probability of a family -> share of cases with it (number)\n")
    for one in reliability(rows):
        print(f"  {one.stated:.2f} -> {one.there:.2f} ({one.number})")
    print()
    print("hidden -> said, one hidden effect or none\n")
    for truth, said in confusion(rows).items():
        print(f"  {truth:22s} " + "; ".join(f"{what} {count}" for what, count in said.items()))
    print("\nshares with 95 % confidence intervals\n")
    _show_confidence(rows)
    print("\ntwo hidden\n")
    for row in of(rows, "two"):
        if not row.right:
            print(f"  {row.seed} {' + '.join(row.truth)}: {row.verdict} {' + '.join(row.found)}")
    print("\ntruth taken out of the catalogue\n")
    for row in of(rows, "left_out"):
        if row.wrong_name:
            print(f"  {row.seed} {row.truth[0]}: {row.verdict} {' + '.join(row.found)}")
    print()
    right = [row for row in rows if row.right]
    show_intervals([one for row in right for one in (*row.intervals, *row.calibrations)])
    for row in rows:
        if row.error:
            print(f"\n{row.variant} {row.seed}: {row.error.strip().splitlines()[-1]}")


def _show_confidence(rows: list[Row]) -> None:
    for name, (count, number, low, high) in confidence(rows).items():
        print(f"  {name:28s} {count:4d} of {number:4d}  {low:.3f} to {high:.3f}")


def show_intervals(stated: Sequence[Held]) -> None:
    """Prints how many intervals of each parameter hold the truth, and how wide they are.

    Half the median width is given in times the median error.
    """
    print("intervals that hold the truth; half of one, in times the median error\n")
    for name in sorted({one.name for one in stated}):
        of_name = [one for one in stated if one.name == name]
        size = [max(abs(one.true), 1e-300) for one in of_name]
        error = median([abs(o.value - o.true) / s for o, s in zip(of_name, size, strict=True)])
        half = median([0.5 * (o.high - o.low) / s for o, s in zip(of_name, size, strict=True)])
        held = sum(one.holds for one in of_name)
        print(f"  {name:40s} {held:3d} of {len(of_name):3d} {half / max(error, 1e-300):8.1f}")
