"""What a virtual robot is built from: its model in its world, limits and friction of its joints, its reflexes."""

import dataclasses

import numpy as np

from mimic.arms.arm import ArmConfig, build_arm
from mimic.arms.capsules import fit_capsules
from mimic.arms.drives import JointFriction, drives_of
from mimic.control.limits import JointLimits
from mimic.metric.capsule_distances import colliding_pairs
from mimic.physics.mujoco_world import MujocoWorld, mujoco_world
from mimic.physics.world import WorldConfig

# External torque at which a Panda's collision reflex stops it [N m], as in libfranka's examples of joint motions. Other
# robots get the smallest of these, as a fraction of the torque limit.
_COLLISION_TORQUE = {"joint1": 20.0, "joint2": 20.0, "joint3": 18.0, "joint4": 18.0, "joint5": 16.0, "joint6": 14.0,
                     "joint7": 12.0}  # fmt: skip
_COLLISION_FRACTION = 18.0 / 87.0


@dataclasses.dataclass(frozen=True)
class RobotModel:
    """What a virtual robot is built from; it can be sent to another process.

    Attributes:
      simulated: the arm with gravity, stops and contacts.
      limits: the manufacturer's, for the reflexes.
      friction: of the joints.
      collision_torque: [joints] external torque at which the robot aborts [N m].
    """

    simulated: MujocoWorld
    limits: JointLimits
    friction: JointFriction
    collision_torque: np.ndarray

    @property
    def num_joints(self) -> int:
        """Number of joints."""
        return self.simulated.model.nv


def robot_model(config: ArmConfig, floor_height: float = 0.0) -> RobotModel:
    """The virtual robot of an arm, with the manufacturer's limits whatever the limits of a training are.

    Args:
      config: the arm.
      floor_height: see `WorldConfig`.

    Raises:
      ValueError: what `build_arm` and `fit_capsules` reject.
    """
    arm = build_arm(config, "hardware")
    features = WorldConfig(gravity=True, stops=True, contacts=True, floor_height=floor_height)
    capsules = fit_capsules(config, "hardware")
    simulated, drives = (
        mujoco_world(arm, features, capsules, colliding_pairs(arm.embodiment, capsules)),
        drives_of(config, arm),
    )
    collision_torque = _COLLISION_FRACTION * drives.limits.torque
    if config.model == "panda":
        collision_torque = np.array([_COLLISION_TORQUE[name] for name in arm.embodiment.joint_names])
    return RobotModel(simulated, drives.limits, drives.friction, collision_torque)
