"""Optional costs of retargeting, which are added to the embodiment distance."""

import dataclasses
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from mimic.arms.capsules import Capsules
from mimic.arms.chain_match import matched_chains
from mimic.arms.embodiment import Embodiment
from mimic.arms.pose_limits import continuous_joints
from mimic.base import spatial
from mimic.base.ranges import check_ranges, number
from mimic.metric.capsule_distances import capsule_axes, intrusion, pair_distances
from mimic.metric.kinematics import LinkStates, joint_frames
from mimic.retargeting.closed_form import SMOOTHING, Smoothing
from mimic.retargeting.optimizers import Derivatives, Scalars
from mimic.retargeting.pose_objective import PoseObjective, Target, automatic_derivatives

_NEAR_LIMIT = 0.1  # fraction of a joint's range at each end where `limits` counts


def _weight() -> float:
    return number(0.0, at_least=0.0, at_most=1e6)


@dataclasses.dataclass(frozen=True)
class Costs:
    """Weights of costs that are added to the embodiment distance; 0 removes a cost.

    Attributes:
      hand_position: squared distance of the tips of the centre lines, each in its arm's chain lengths; of trees, the
        sum over the pairs of corresponding chains.
      home: mean over the joints of the squared distance from the home pose, in half ranges.
      limits: mean over the joints of the squared intrusion into the last tenth of the range at each end; 1 at a limit.
      velocity, acceleration: mean over the joints of the squared first and second difference of the angles [rad^2] from
        one time to the next; of `imitate_trajectory` alone.
      self_collision: sum over pairs of capsules of ((clearance - d) / clearance)^2, where their distance d is less than
        the clearance; d is negative where they intersect. See `Capsules.pairs`.
      floor: the same for the distance of each capsule from the floor, except those on the base and the first joint.
      clearance: of collisions [m].
      floor_height: height of the floor in the base frame [m].
    """

    hand_position: float = _weight()
    home: float = _weight()
    limits: float = _weight()
    velocity: float = _weight()
    acceleration: float = _weight()
    self_collision: float = _weight()
    floor: float = _weight()
    clearance: float = number(0.02, above=0.0, at_most=1e3)
    floor_height: float = number(0.0, at_least=-1e3, at_most=1e3)

    def __post_init__(self) -> None:
        check_ranges(self, "costs.")

    @property
    def of_pose(self) -> bool:
        """Whether a cost of single poses has a weight."""
        return any((self.hand_position, self.home, self.limits, self.of_capsules))

    @property
    def of_capsules(self) -> bool:
        """Whether a cost of capsules has a weight."""
        return bool(self.self_collision or self.floor)

    @property
    def of_motion(self) -> bool:
        """Whether a cost of motions has a weight."""
        return bool(self.velocity or self.acceleration)

    def check_capsules(self, capsules: Capsules | None) -> None:
        """Raises a `ValueError` where capsules are missing."""
        if self.of_capsules and capsules is None:
            raise ValueError("capsules: costs.self_collision and costs.floor need them, as from fit_capsules(config)")


NO_COSTS = Costs()


def pose_cost(
    costs: Costs,
    expert: Embodiment,
    learner: Embodiment,
    capsules: Capsules | None,
    expert_qpos: Float[Array, " joints"],
    qpos: Float[Array, " learner_joints"],
) -> Float[Array, ""]:
    """Weighted sum of the costs of a learner's pose."""
    total = jnp.zeros((), qpos.dtype)
    if costs.hand_position:
        total += costs.hand_position * hand_cost(expert, learner, expert_qpos, qpos)
    if costs.home or costs.limits:
        total += costs.home * home_cost(learner, qpos) + costs.limits * limit_cost(learner, qpos)
    if costs.of_capsules and capsules is not None:
        start, end = capsule_axes(learner, capsules, qpos)
        if costs.self_collision and capsules.pairs:
            distance = pair_distances(capsules, start, end)
            total += costs.self_collision * intrusion(distance, costs.clearance)
        if costs.floor:
            moves = np.flatnonzero(~np.array(capsules.near_base))
            height = jnp.minimum(start[moves, 2], end[moves, 2]) - jnp.asarray(capsules.radius[moves], qpos.dtype)
            total += costs.floor * intrusion(height - costs.floor_height, costs.clearance)
    return total


def hand_cost(expert: Embodiment, learner: Embodiment, expert_qpos: Array, qpos: Array) -> Float[Array, ""]:
    """Squared distance of the tips, summed over pairs of chains."""
    pairs = np.array(matched_chains(expert.chain_names, learner.chain_names)).T
    points = [
        tip_positions(arm, q)[chains] / spatial.scalar(arm.chain_length)
        for (arm, q), chains in zip(((expert, expert_qpos), (learner, qpos)), pairs, strict=True)
    ]
    return jnp.sum((points[0] - points[1]) ** 2)


def tip_positions(arm: Embodiment, qpos: Float[Array, " joints"]) -> Float[Array, "chains 3"]:
    """End of the last segment of each chain [m]."""
    frames, tips = joint_frames(arm, jnp.asarray(qpos), None), []
    for chain in arm.chains:
        joint = arm.link_joint[chain[-1]]
        last = max(segment for segment, link in enumerate(arm.segment_link) if link == chain[-1])
        anchor = arm.joint_anchor[joint] if joint >= 0 else np.zeros(3)
        offset = spatial.vector(arm.segment_end[last] - anchor)
        tips.append(spatial.add(frames[joint + 1].anchor, spatial.rotate(frames[joint + 1].rotation, offset)))
    return spatial.stack(tips, qpos.dtype)


def home_cost(arm: Embodiment, qpos: Float[Array, " joints"]) -> Float[Array, ""]:
    """Mean squared distance from the home pose, in half ranges; periodic for joints of a full revolution."""
    lower, upper = np.asarray(arm.joint_range).T
    difference = qpos - np.asarray(arm.home)
    square = jnp.where(continuous_joints(arm), 2 * (1 - jnp.cos(difference)), difference**2)
    return jnp.mean(square / ((upper - lower) / 2) ** 2).astype(qpos.dtype)


def limit_cost(arm: Embodiment, qpos: Float[Array, " joints"]) -> Float[Array, ""]:
    """Mean squared intrusion into the last tenth of the range at each end; 0 for joints of a full revolution."""
    lower, upper = np.asarray(arm.joint_range).T
    margin = _NEAR_LIMIT * (upper - lower)
    intrusion = jnp.maximum(0, 1 - jnp.minimum(qpos - lower, upper - qpos) / margin)
    return jnp.mean(jnp.where(continuous_joints(arm), 0, intrusion**2)).astype(qpos.dtype)


def with_costs(
    objective: PoseObjective, costs: Costs, expert: Embodiment, learner: Embodiment, capsules: Capsules | None
) -> PoseObjective:
    """The objective plus the costs of single poses, by automatic differentiation; unchanged where none has a weight."""
    if not costs.of_pose:
        return objective

    def target(states: LinkStates, expert_qpos: Array) -> Target:
        return objective.target(states, expert_qpos), expert_qpos

    def value(target: Target, states: LinkStates) -> Array:  # of initial guesses, so without the costs
        return objective.value(target[0], states)

    def total(target: Target, qpos: Scalars, smoothing: Smoothing = SMOOTHING) -> Derivatives:
        base = objective.derivatives(target[0], qpos, smoothing)
        cost = automatic_derivatives(lambda q: pose_cost(costs, expert, learner, capsules, target[1], q), qpos)
        return sum_of(base, cost)

    return dataclasses.replace(objective, target=target, value=value, derivatives=total, is_elementwise=False)


def smoothness_derivatives(costs: Costs, qpos: Scalars, previous: Array, earlier: Array) -> Derivatives:
    """Derivatives of the costs of motions, at a pose that follows two others."""
    joints = len(qpos)
    value: Any = 0.0
    gradient = []
    for q, p, e in zip(qpos, previous, earlier, strict=True):
        velocity, acceleration = q - p, q - 2 * p + e
        value = value + (costs.velocity * velocity**2 + costs.acceleration * acceleration**2) / joints
        gradient.append(2 * (costs.velocity * velocity + costs.acceleration * acceleration) / joints)
    curvature = 2 * (costs.velocity + costs.acceleration) / joints
    return Derivatives(value, gradient, [[curvature * (i == j) for j in range(i + 1)] for i in range(joints)])


def sum_of(a: Derivatives, b: Derivatives) -> Derivatives:
    """Derivatives of a sum of two functions."""
    gradient = tuple(x + y for x, y in zip(a.gradient, b.gradient, strict=True))
    rows = zip(a.hessian, b.hessian, strict=True)
    hessian = tuple(tuple(x[j] + y[j] for j in range(i + 1)) for i, (x, y) in enumerate(rows))
    return Derivatives(a.value + b.value, gradient, hessian)
