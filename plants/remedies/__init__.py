"""What can be done about the effects of a diagnosis, and what each remedy will bring.

It takes a finished diagnosis as a value: the effects found, their intervals, the fitted model.
"""

from plants.remedies.offers import Offer, offers_for

__all__ = ["Offer", "offers_for"]
