"""A pose mapper to any arm with constant arms, and the arms that it is given."""

import dataclasses

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from mimic.arms.arm import Arm
from mimic.arms.arrays import MAX_JOINTS, ArmArrays, arm_arrays
from mimic.arms.embodiment import Embodiment
from mimic.metric.config import MetricConfig
from mimic.trainers.pose_mapper.any_arm_model import AnyArmMapperModel, ExpertPose, Params, expert_pose


@dataclasses.dataclass(frozen=True, eq=False)
class DescribedArm:
    """An arm and the arrays that the network takes.

    Attributes:
      arm: with its locked joints.
      arrays: in single precision.
      joints: slot of each of the arm's own joints in the arrays; those that are locked are not among them.
      slots: name of the joint in each of the first slots, locked ones included.
    """

    arm: Arm
    arrays: ArmArrays
    joints: Int[np.ndarray, " joints"]
    slots: tuple[str, ...]

    @classmethod
    def without_locks(cls, arm: Arm) -> "DescribedArm":
        """An arm whose locked joints have no slot."""
        names = arm.embodiment.joint_names
        return cls(arm, arm_arrays(arm).astype(np.float32), np.arange(len(names)), names)

    def in_slots(self, qpos: Float[Array, "*batch joints"]) -> Float[Array, "*batch 8"]:
        """Poses of the arm's own joints [rad] with an angle for each slot: home in the others."""
        own = len(self.joints)
        source = own + np.arange(MAX_JOINTS)
        source[self.joints] = np.arange(own)
        home = jnp.broadcast_to(jnp.asarray(self.arrays.home, qpos.dtype), (*qpos.shape[:-1], MAX_JOINTS))
        return jnp.concatenate([qpos, home], axis=-1)[..., source]  # exported functions have no scatter


@dataclasses.dataclass(frozen=True, eq=False)
class OnePairModel:
    """A mapper to any arm with constant arms; the same functions as of `MapperModel`.

    Attributes:
      mapper: the mapper to any arm.
      expert_arm, learner_arm: the two arms.
      metric: config of the metric.
    """

    mapper: AnyArmMapperModel
    expert_arm: DescribedArm
    learner_arm: DescribedArm
    metric: MetricConfig

    @property
    def expert(self) -> Embodiment:
        """Embodiment with n joints."""
        return self.expert_arm.arm.embodiment

    @property
    def learner(self) -> Embodiment:
        """Embodiment with n_hat joints."""
        return self.learner_arm.arm.embodiment

    def _expert_pose(self, qpos: Array) -> ExpertPose:
        return expert_pose(self.expert_arm.arrays, self.expert_arm.in_slots(qpos))

    def candidates(self, params: Params, qpos: Float[Array, " joints"]) -> Float[Array, "poses learner_joints"]:
        """All poses after the Newton steps [rad]."""
        learner = self.learner_arm
        return self.mapper.refined(params, self._expert_pose(qpos), learner.arrays)[0][:, learner.joints]

    def distance(self, qpos: Float[Array, " joints"], learner_qpos: Float[Array, " learner_joints"]) -> Array:
        """Embodiment distance between a pose of the expert and a pose of the learner."""
        learner = self.learner_arm
        return self.mapper.distance(self._expert_pose(qpos), learner.arrays, learner.in_slots(learner_qpos))

    def __call__(self, params: Params, qpos: Float[Array, " joints"]) -> Float[Array, " learner_joints"]:
        """The nearest of the poses after the Newton steps."""
        learner = self.learner_arm
        return self.mapper(params, self._expert_pose(qpos), learner.arrays)[learner.joints]
