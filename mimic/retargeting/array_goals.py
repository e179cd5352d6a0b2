"""Local minima of the metric over an arm's poses, which a controller follows and changes between.

The nearest pose of an arm with few joints jumps from one local minimum to another while the expert moves. So several
minima are followed in time by Newton steps, the one that the arm moves to (the goal) and others, and in each step
minima from random poses join them. What it is worth to change to another one is estimated from the metric on the
straight way there, at a constant speed, and from the metric at its end for the rest of a time horizon, as if the expert
stood still.
"""

import dataclasses
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from mimic.arms.arrays import MAX_JOINTS, ArmArrays
from mimic.metric.distance import DistanceWeights, Metric
from mimic.metric.hand import HandWeights
from mimic.metric.kinematics import LinkStates, link_states
from mimic.retargeting.array_nearest import NearestPose, nearest_pose

NEWTON_STEPS = 3  # of each pose; 1 gives a gap of 0.16 instead of 0.14 % on panda4dof, 8 gives 0.13 %
OTHERS = 4  # minima that are followed beside the goal
NEW_POSES = 2  # random poses that join in each step
_POSES = 5  # folded into an episode's key: others are the noise and the start of the episode
_SAME = 0.05  # rad, maximum over the joints: minima at a smaller difference are the same
_SPEED = 2.0  # on the way to another minimum, in velocity limits
_HORIZON = 60.0  # control steps, of an estimate
_ON_THE_WAY = (0.0, 0.33, 0.67, 1.0)  # fractions of the way where the metric is evaluated
# Of another minimum, for a change to it. With 0.1 and a horizon of 40, real arms change too often: a mean gap of 5.7
# instead of 4.4 %; without changes that of locked Pandas is 2.8 instead of 1.3 %.
MIN_ADVANTAGE = 0.2


@dataclasses.dataclass(frozen=True, eq=False)
class Problem:
    """An arm and the expert that it imitates in the next step.

    Attributes:
      arm: the arm.
      weights: of the metric.
      matrix: correspondence of the links.
      expert: link states of the expert at the next step, [slots of links, 3] each.
      control_dt: duration of a step [s].
      hand_rotation: weight of the hand's rotation.
    """

    arm: ArmArrays
    weights: DistanceWeights
    matrix: Float[Array, "expert links"]
    expert: LinkStates
    control_dt: float
    hand_rotation: float = 0.0

    def nearest(self, qpos: Float[Array, " joints"], steps: int) -> NearestPose:
        """The result of Newton steps from a pose, see `nearest_pose`."""
        hand = self.hand_rotation
        return nearest_pose(self.arm, self.weights, self.matrix, self.expert, qpos, steps, hand_rotation=hand)

    def distance(self, qpos: Float[Array, " joints"]) -> Float[Array, ""]:
        """Embodiment distance of a pose, without velocities."""
        weights = dataclasses.replace(self.weights, linear_velocity=0.0, angular_velocity=0.0)
        metric = Metric(self.matrix, weights, hand_weights=HandWeights(self.hand_rotation))
        return metric(self.expert, link_states(self.arm, qpos))


class Goals(NamedTuple):
    """The minima of an arm at one time.

    Attributes:
      goal: the one that the arm moves to.
      others: [others, joints] further ones [rad].
      best: the one among the others that is worth most.
      advantage: of `best` over `goal`: the fraction of the estimated distance that it saves; -1 where it is the same.
    """

    goal: NearestPose
    others: Float[Array, "others joints"]
    best: NearestPose
    advantage: Float[Array, ""]


def first_goals(qpos: Float[Array, " joints"]) -> Goals:
    """What `next_goals` starts from: the arm's own pose."""
    zeros = jnp.zeros_like(qpos)
    here = NearestPose(qpos, zeros, zeros)
    return Goals(here, jnp.tile(qpos, (OTHERS, 1)), here, -jnp.ones((), qpos.dtype))


def chosen_goal(goals: Goals) -> Goals:
    """The goals after the decision whether to change to the best of the others."""
    changes = goals.advantage > MIN_ADVANTAGE
    goal = jax.tree.map(lambda new, old: jnp.where(changes, new, old), goals.best, goals.goal)
    return goals._replace(goal=goal)


def next_goals(
    problem: Problem, goals: Goals, qpos: Float[Array, " joints"], random: Float[Array, "new joints"]
) -> Goals:
    """The goals when the expert has moved on.

    Args:
      problem: arm and expert.
      goals: those of the last step, after `chosen_goal`.
      qpos: the arm's pose [rad].
      random: numbers in [0, 1], new in each step: random poses, as fractions of the joints' ranges.
    """
    poses = jnp.concatenate([goals.others, _random_poses(problem.arm, random), goals.goal.qpos[None]])
    # One function for all of them compiles several times faster than one for each kind.
    near = jax.vmap(lambda pose: problem.nearest(pose, NEWTON_STEPS))(poses)
    near = near._replace(qpos=_without_revolutions(problem.arm, near.qpos, qpos))
    goal, others, poses = jax.tree.map(lambda x: x[-1], near), jax.tree.map(lambda x: x[:-1], near), near.qpos
    estimate, distance = jax.vmap(lambda pose: _estimates(problem, qpos, pose))(poses)
    differences = jnp.max(jnp.abs(poses[:, None] - poses) * problem.arm.is_free, axis=-1)
    is_goal = differences[:-1, -1] < _SAME
    best = jnp.argmin(estimate[:-1] + 1e3 * is_goal)
    advantage = 1 - estimate[best] / jnp.maximum(estimate[-1], 1e-3)
    advantage = jnp.where(is_goal[best], -1.0, jnp.clip(advantage, -1.0, 1.0))
    repeats = jnp.any(jnp.tril(differences[:-1, :-1] < _SAME, -1), axis=1) | is_goal
    order = jnp.argsort(distance[:-1] + 1e2 * repeats)
    return Goals(goal, others.qpos[order[:OTHERS]], jax.tree.map(lambda x: x[best], others), advantage)


def random_numbers(key: Array, step: Array) -> Float[Array, "new joints"]:
    """The random numbers of a step for `next_goals`.

    Args:
      key: random key of the episode.
      step: control steps since the start of the episode.
    """
    key = jax.random.fold_in(jax.random.fold_in(key, _POSES), step)
    return jax.random.uniform(key, (NEW_POSES, MAX_JOINTS))


def _random_poses(arm: ArmArrays, random: Float[Array, "new joints"]) -> Float[Array, "new joints"]:
    lower, upper = arm.joint_range[:, 0], arm.joint_range[:, 1]
    return jnp.where(arm.is_free > 0, lower + random * (upper - lower), arm.home)


def _without_revolutions(
    arm: ArmArrays, poses: Float[Array, "poses joints"], qpos: Float[Array, " joints"]
) -> Float[Array, "poses joints"]:
    """The same poses at the shortest way from a pose, where a joint can rotate by full revolutions."""
    revolutions = 2 * jnp.pi * jnp.round((poses - qpos) / (2 * jnp.pi))
    return jnp.where(jnp.isinf(arm.angle_limits[0]), poses - revolutions, poses)


def _estimates(
    problem: Problem, qpos: Float[Array, " joints"], pose: Float[Array, " joints"]
) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """The mean distance over the horizon of a motion from one pose to another, and the distance at its end."""
    arm, way = problem.arm, pose - qpos
    steps = jnp.max(jnp.abs(way) / (_SPEED * problem.control_dt * arm.velocity_limit) * arm.is_free)
    distances = jax.vmap(lambda fraction: problem.distance(qpos + fraction * way))(jnp.array(_ON_THE_WAY))
    moving = jnp.minimum(steps / _HORIZON, 1.0)
    return moving * distances[:-1].mean() + (1 - moving) * distances[-1], distances[-1]
