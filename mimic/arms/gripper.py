"""How far a gripper is open: its joints distal of an arm's hand, and their angles or lengths when open and closed."""

from typing import NamedTuple

import mujoco
import numpy as np
from jaxtyping import Float

from mimic.arms.arm import ArmConfig, arm_spec, build_arm
from mimic.arms.model_tree import ancestors
from mimic.arms.mujoco_chain import data_at_zero
from mimic.arms.names import is_sensor
from mimic.arms.tool_frames import find_gripper

_SAME = 1e-4  # m: fingers that come no nearer to each other


class GripperRange(NamedTuple):
    """The joints of a gripper.

    Attributes:
      names: of its joints.
      closed, opened: their values then [m, rad].
    """

    names: tuple[str, ...]
    closed: Float[np.ndarray, " joints"]
    opened: Float[np.ndarray, " joints"]

    @property
    def travel(self) -> float:
        """How much wider it is when open: of two slides that of both, of others that of the first joint."""
        travel = np.abs(self.opened - self.closed)
        return float(travel.sum() if len(travel) == 2 else travel[0])


def gripper_range(config: ArmConfig) -> GripperRange | None:
    """The gripper of an arm; None without one, or where the model does not limit its joints.

    A joint is open at the end of its range at which the fingers are farther apart; where it moves one finger alone, at
    the end farther from zero.
    """
    arm, model = build_arm(config, "none").embodiment, arm_spec(config).compile()
    data = data_at_zero(model)
    wrist = model.joint(arm.joint_names[-1])
    last, anchor = int(wrist.bodyid[0]), data.xanchor[wrist.id].copy()
    moving = [body for body in range(last + 1, model.nbody) if last in ancestors(model, body)]
    joints = [
        joint for joint in range(model.njnt)
        if model.jnt_bodyid[joint] in moving and not is_sensor(model.body(model.jnt_bodyid[joint]).name)
    ]  # fmt: skip
    if len(arm.hand_joint) != 1 or not joints or not model.jnt_limited[joints].all():
        return None
    address, ranges = model.jnt_qposadr[joints], model.jnt_range[joints]

    def width(joint: int, end: int) -> float:
        data.qpos[address] = ranges.mean(axis=1)
        data.qpos[address[joint]] = ranges[joint, end]
        mujoco.mj_kinematics(model, data)
        tips = np.array([finger.frame.point for finger in find_gripper(model, data, last, anchor).fingers])
        return float(np.linalg.norm(tips - tips.mean(axis=0), axis=1).sum())

    ends = []
    for joint, limits in enumerate(ranges):
        wider = width(joint, 1) - width(joint, 0)
        ends.append(int(wider > 0) if abs(wider) > _SAME else int(np.argmax(np.abs(limits))))
    every = np.arange(len(joints))
    names = tuple(model.joint(joint).name for joint in joints)
    return GripperRange(names, ranges[every, 1 - np.array(ends)], ranges[every, ends])
