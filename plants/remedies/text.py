"""The remedies of a diagnosis as text and as JSON values."""

from collections.abc import Sequence
from dataclasses import asdict
from typing import Any

from estune.core.gains import Gains
from plants.remedies.behaviour import MEASURES
from plants.remedies.offers import WORTH, Offer, PredictedRatio

PLACES = {
    "loop": "in the loop",
    "calibration": "calibration",
    "workshop": "workshop",
    "limit": "a limit",
}
COLUMNS = ("what to do", "where", *MEASURES)
WORK_COLUMNS = ("what to do", "work", "may harm")


def rows(offers: Sequence[Offer]) -> tuple[tuple[str, ...], ...]:
    """A row for each remedy, under `COLUMNS`: predicted ratios of with to without."""
    return tuple(
        (
            _what(offer),
            PLACES[offer.place],
            *(_ratio(offer.ratios.get(name)) for name in MEASURES),
        )
        for offer in offers
    )


def work_rows(offers: Sequence[Offer]) -> tuple[tuple[str, ...], ...]:
    """A row for each remedy, under `WORK_COLUMNS`: the work it takes, and what it may harm."""
    return tuple((offer.title, offer.work, offer.harm or "-") for offer in offers)


def sentences(diagnosis: Any, offers: Sequence[Offer]) -> tuple[str, ...]:
    """What cannot be done yet, and what experiment would help."""
    found = [f"{offer.effect}: not yet; {offer.refused}." for offer in offers if offer.refused]
    predicted = next((offer.gains for offer in offers if offer.gains is not None), None)
    if predicted is not None:
        found.append(f"These are predictions for the gains {gains_in_words(predicted)}.")
    next_one = diagnosis.next_experiment
    if diagnosis.verdict in ("unknown", "incomplete", "ambiguous") and next_one is not None:
        told = "What is not named cannot be remedied."
        if diagnosis.verdict == "ambiguous" and offers:
            told = "The records allow another effect, whose remedy is another."
        found.append(f"{told} {full_sentence(next_one.sentence)}")
    if diagnosis.verdict == "none":
        hidden = ", ".join(diagnosis.hidden)
        told = f"; these records cannot show {hidden}" if hidden else ""
        found.append(f"The model lacks nothing that could be remedied{told}.")
    return tuple(found)


def gains_in_words(gains: Gains) -> str:
    """Gains as they are written for --gains."""
    names = ("P", "I", "D", "F")
    return ",".join(f"{n}={v:.4g}" for n, v in zip(names, gains.as_tuple(), strict=True))


def to_json(offers: Sequence[Offer]) -> list[dict[str, Any]]:
    """The remedies as JSON values."""
    return [asdict(offer) for offer in offers]


def _what(offer: Offer) -> str:
    if offer.refused:
        return f"{offer.title} (not yet)"
    if offer.worth is False:
        return f"{offer.title} (not worth it: gains under {WORTH:.0%}, or costs as much elsewhere)"
    return offer.title


def _ratio(ratio: PredictedRatio | None) -> str:
    if ratio is None:
        return "-"
    return f"{ratio.value:.2f} [{ratio.low:.2f}, {ratio.high:.2f}]"


def full_sentence(text: str) -> str:
    """The text with a capital and a full stop."""
    return f"{text[:1].upper()}{text[1:].rstrip('.')}."
