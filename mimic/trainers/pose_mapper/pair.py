"""A pair of arms of a pose mapper: constants that are closed over, or arrays, for which one function takes any pair."""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from mimic.arms.arrays import ArmArrays
from mimic.arms.embodiment import Embodiment
from mimic.arms.pose_limits import continuous_joints
from mimic.metric.correspondence import arc_length_correspondence
from mimic.metric.distance import DistanceWeights, Metric
from mimic.metric.kinematics import LinkStates, link_states
from mimic.retargeting.array_nearest import nearest_pose

Arm = Embodiment | ArmArrays  # of the latter, poses have an angle for each slot of a joint
Poses = Float[Array, "poses joints"]


@dataclasses.dataclass(frozen=True, eq=False)
class Pair:
    """Two arms of the same type, and the metric between them.

    Attributes:
      expert: n joints.
      learner: n_hat joints.
      metric: defines the nearest pose; of arrays, of constant weights.
    """

    expert: Arm
    learner: Arm
    metric: Metric

    @classmethod
    def of_arrays(cls, expert: ArmArrays, learner: ArmArrays, weights: DistanceWeights) -> "Pair":
        """Two arms that may be arguments of a compiled function."""
        return cls(expert, learner, Metric(arc_length_correspondence(expert, learner), weights))

    def target(self, qpos: Float[Array, " joints"]) -> "Target":
        """A pose of the expert [rad], for the learner to imitate."""
        return Target(self, qpos, link_states(self.expert, qpos))


@dataclasses.dataclass(frozen=True, eq=False)
class Target:
    """A pose of the expert, for the learner to imitate; functions of one sample.

    Attributes:
      pair: the arms.
      qpos: [n] the pose [rad].
      states: the expert's link states at rest in this pose.
    """

    pair: Pair
    qpos: Float[Array, " joints"]
    states: LinkStates

    def distance(self, qpos: Float[Array, " learner_joints"]) -> Float[Array, ""]:
        """Embodiment distance of a pose of the learner [rad], at rest."""
        return self.pair.metric(self.states, link_states(self.pair.learner, qpos))

    def distances(self, poses: Poses) -> Float[Array, " poses"]:
        """Embodiment distances of poses of the learner [rad]."""
        return jax.vmap(self.distance)(poses)

    def improved(self, poses: Poses, steps: int) -> Poses:
        """Poses of the learner after Newton steps [rad]; of arms as arrays alone."""
        learner, metric = self.pair.learner, self.pair.metric
        weights, matrix = metric.weights, jnp.asarray(metric.correspondence)
        assert isinstance(learner, ArmArrays) and isinstance(weights, DistanceWeights)

        def improve(qpos: Array) -> Array:
            return nearest_pose(learner, weights, matrix, self.states, qpos, steps).qpos

        return jax.vmap(improve)(poses) if steps else poses

    def nearest(self, poses: Poses) -> tuple[Float[Array, ""], Float[Array, " learner_joints"]]:
        """The smallest distance of some poses of the learner, and the pose [rad]."""
        distances = self.distances(poses)
        first = jnp.argmin(distances)
        return distances[first], poses[first]


def random_poses(arm: Arm, key: Array, shape: tuple[int, ...] = ()) -> Float[Array, "*shape joints"]:
    """Poses [rad], uniform within the joints' ranges; locked joints are at home."""
    lower, upper = jnp.asarray(arm.joint_range, jnp.float32).T
    qpos = jax.random.uniform(key, (*shape, len(lower)), jnp.float32, minval=lower, maxval=upper)
    return at_home_where_locked(arm, qpos)


def at_home_where_locked(arm: Arm, qpos: Float[Array, "*batch joints"]) -> Float[Array, "*batch joints"]:
    """The poses with locked joints and empty slots at home."""
    if isinstance(arm, Embodiment):
        return qpos
    return jnp.where(jnp.asarray(arm.is_free) > 0, qpos, jnp.asarray(arm.home, qpos.dtype))


def poses_within_range(arm: Arm, outputs: Float[Array, "*batch joints 2"], *, on_circle: bool) -> Any:
    """Poses [rad] from two numbers for each joint, of which the first one suffices for joints with limits.

    Args:
      arm: the arm.
      outputs: any numbers.
      on_circle: whether they are a point whose direction is the angle, for joints that rotate by a full revolution;
        the angle is then continuous in the outputs at pi.
    """
    if isinstance(arm, ArmArrays):
        lower, upper = arm.joint_range[:, 0], arm.joint_range[:, 1]
        zero = arm.home
    else:
        lower, upper = (jnp.asarray(bound, outputs.dtype) for bound in np.asarray(arm.joint_range).T)
        zero = 0.0
    poses = (lower + upper) / 2 + (upper - lower) / 2 * jnp.tanh(outputs[..., 0])
    if on_circle:
        poses = jnp.where(continuous_joints(arm), zero + jnp.arctan2(outputs[..., 1], outputs[..., 0]), poses)
    return at_home_where_locked(arm, poses)
