"""Age of setpoints: which to drop because a newer one arrived before, or they were long under way.

The clocks of client and rig have an unknown difference, so a setpoint's delay on the network is
known only relative to the quickest before it: received - sent, minus the least such difference.
"""

from typing import NamedTuple

from estune.trial import SETPOINT_S

DRIFT = 1e-3
"""Greatest relative difference of two clocks' rates: NTP slews by 5e-4, crystals are off by 1e-4.

The least difference is raised at this rate, or a slower clock of the client would age its
setpoints by 0.2 s within an hour."""


class SetpointAge(NamedTuple):
    """The last setpoint taken, of one lease.

    Attributes:
        sent_s: Time of sending, s, on the client's clock.
        received_s: Time of arrival, s, on the rig's clock.
        difference_s: Least time from sending to arrival, s, of the two clocks.
    """

    token: str = ""
    sent_s: float = 0.0
    received_s: float = 0.0
    difference_s: float = 0.0

    def next(self, token: str, sent_s: float, received_s: float) -> "SetpointAge | None":
        """The setpoint after this one; None for one that must be dropped."""
        difference_s = received_s - sent_s
        if token == self.token:
            if sent_s <= self.sent_s:
                return None
            least_s = self.difference_s + DRIFT * (received_s - self.received_s)
            if difference_s - least_s > SETPOINT_S:
                return None
            difference_s = min(difference_s, least_s)
        return SetpointAge(token, sent_s, received_s, difference_s)
