"""What a virtual robot is built from: its model in its world, limits and friction of its joints."""

import dataclasses

from mimic.arms.arm import ArmConfig, build_arm
from mimic.arms.capsules import fit_capsules
from mimic.arms.drives import JointFriction, drives_of
from mimic.control.limits import JointLimits
from mimic.metric.capsule_distances import colliding_pairs
from mimic.physics.mujoco_world import MujocoWorld, mujoco_world
from mimic.physics.world import WorldConfig


@dataclasses.dataclass(frozen=True)
class RobotModel:
    """What a virtual robot is built from; it can be sent to another process.

    Attributes:
      simulated: the arm with gravity, stops and contacts.
      limits: the manufacturer's, for the reflexes.
      friction: of the joints.
    """

    simulated: MujocoWorld
    limits: JointLimits
    friction: JointFriction

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
    simulated = mujoco_world(arm, features, capsules, colliding_pairs(arm.embodiment, capsules))
    drives = drives_of(config, arm)
    return RobotModel(simulated, drives.limits, drives.friction)
