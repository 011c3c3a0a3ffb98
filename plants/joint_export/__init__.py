"""The identified joint in the formats of other simulators, with what a format cannot say named."""

from plants.joint_export.files import ENDINGS, check_export, export
from plants.joint_export.joint import Joint, JointNumber, joint_of

__all__ = ["ENDINGS", "Joint", "JointNumber", "check_export", "export", "joint_of"]
