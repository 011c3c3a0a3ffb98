"""A rig as topics of ROS 2, by plain puts into the Zenoh network of rmw_zenoh (0.2.4 or later).

Key and attachment of a message and the liveliness tokens of node and publishers are those of
rmw_zenoh; with `dds`, keys are those of zenoh-bridge-ros2dds, the topic's name alone.
"""

import hashlib
import re
import struct
import time
from typing import NamedTuple

from estune.bridges import cdr
from estune.bridges.viewer import ViewedRig, ViewedSample
from estune.core.gains import GAIN_NAMES
from estune.errors import InvalidInput
from estune.remote.zenoh.put_session import PutSession
from estune.trial import RigDescription

DOMAIN_MAX = 232
"""Greatest domain id of ROS 2."""

OK, ERROR, STALE = 0, 2, 3
"""Levels of a diagnostic."""

_QOS = "::,10:,:,:,,"
"""Reliable, volatile, the last ten kept, the rest as by default."""

_ATTACHMENT = struct.Struct("<qqB16s")
"""Sequence number, time in ns, length of the publisher's id, the id."""


class MessageType(NamedTuple):
    """Type of a message: its name on the bus, and its hash (REP 2011)."""

    name: str
    type_hash: str


JOINT_STATE = MessageType(
    "sensor_msgs::msg::dds_::JointState_",
    "RIHS01_a13ee3a330e346c9d87b5aa18d24e11690752bd33a0350f11c5882bc9179260e",
)
WRENCH_STAMPED = MessageType(
    "geometry_msgs::msg::dds_::WrenchStamped_",
    "RIHS01_8dc3deaf06b2ab281f9f9a742a8961c328ca7cec16e3fd6586d3a5c83fa78f77",
)
DIAGNOSTIC_ARRAY = MessageType(
    "diagnostic_msgs::msg::dds_::DiagnosticArray_",
    "RIHS01_5a8a36efb05fb25070fa0fb3810290c0e6cd4862b54a8fb975a1ee8dc55a333e",
)


class _Publisher:
    def __init__(self, put: PutSession, key: str, token: str) -> None:
        self._put, self._key = put, key
        self._gid = hashlib.sha256(token.encode()).digest()[:16] if token else b""
        self._sequence = 0
        if token:
            put.declare_token(token)

    def publish(self, payload: bytes) -> None:
        attachment = None
        if self._gid:
            self._sequence += 1
            attachment = _ATTACHMENT.pack(
                self._sequence, time.time_ns(), len(self._gid), self._gid
            )
        self._put.put(self._key, payload, attachment)


class Ros2Viewer:
    """Topics `<rig>/joint_states`, `<rig>/tension` and `diagnostics`; implements `Viewer`.

    The joint state has the drum's angle and, where the radius is known, the torque; never the
    tension, which is a force along x of the frame named like the rig. A rig that measures
    something else than a force has no such topic.

    Args:
        put: Session with the router of the ROS network.
        domain: Domain id of ROS.
        dds: Whether the messages go to DDS by zenoh-bridge-ros2dds.
        drum_radius_m: Radius that turns the current's force into a torque; None for no torque.

    Raises:
        InvalidInput: there is no such domain.
    """

    def __init__(
        self,
        put: PutSession,
        rig: RigDescription,
        *,
        domain: int = 0,
        dds: bool = False,
        drum_radius_m: float | None = None,
    ) -> None:
        if not 0 <= domain <= DOMAIN_MAX:
            raise InvalidInput(f"domain is {domain}; it must be from 0 to {DOMAIN_MAX}")
        self.name = ros_name(rig.name)
        self._hardware_id = rig.name
        self._torque_Nm_A = (
            None if drum_radius_m is None else rig.newtons_per_ampere * drum_radius_m
        )
        node = f"@ros2_lv/{domain}/{put.session_id}/0"
        if not dds:
            put.declare_token(f"{node}/0/NN/%/%/{self.name}")

        def publisher(entity: int, topic: str, kind: MessageType) -> _Publisher:
            if dds:
                return _Publisher(put, topic, "")
            kinds = "/".join(kind)
            mangled = "%" + topic.replace("/", "%")
            token = f"{node}/{entity}/MP/%/%/{self.name}/{mangled}/{kinds}/{_QOS}"
            return _Publisher(put, f"{domain}/{topic}/{kinds}", token)

        self._joints = publisher(1, f"{self.name}/joint_states", JOINT_STATE)
        self._diagnostics = publisher(2, "diagnostics", DIAGNOSTIC_ARRAY)
        measures_force = rig.measurement.endswith(", N")
        self._force = (
            publisher(3, f"{self.name}/tension", WRENCH_STAMPED) if measures_force else None
        )

    def show_samples(self, samples: list[ViewedSample]) -> None:
        """Publishes a joint state and a force for each sample."""
        for sample in samples:
            torque_Nm = None if self._torque_Nm_A is None else self._torque_Nm_A * sample.current_A
            at, angle = sample.time_ns, sample.angle_rad
            self._joints.publish(cdr.joint_state(at, self.name, angle, torque_Nm))
            if self._force is not None:
                self._force.publish(cdr.wrench_stamped(at, self.name, sample.tension_N))

    def show_state(self, state: ViewedRig) -> None:
        """Publishes the status, with the live gains."""
        status, about = state.status, state.about
        values = {}
        if status is None:
            level, message = STALE, "the rig does not answer"
        else:
            level, message = OK, status.mode.sentence
            if status.latched:
                level, message = ERROR, f"held in its safe state: {status.latched}"
            values = {"trial": status.trial_id, "holder": status.holder}
        if about is not None:
            values |= {name: f"{getattr(about.gains, name):.6g}" for name in GAIN_NAMES}
        found = cdr.Diagnostic(level, f"{self.name}: rig", message, self._hardware_id, values)
        self._diagnostics.publish(cdr.diagnostic_array(state.time_ns, [found]))


def ros_name(name: str) -> str:
    """A name that ROS allows: letters, digits and underscores, a letter first."""
    changed = re.sub(r"\W", "_", name, flags=re.ASCII)
    return changed if changed[:1].isalpha() else f"rig_{changed}"
