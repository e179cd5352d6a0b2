"""Poses of the learner whose hand is where the expert's is, and of these the nearest in the metric.

Each descent minimises the cost of the hand plus a small weight of the metric by Newton's method, so that it ends near
the nearest of the postures on its branch. The metric is then left out, and a few steps with little damping, which
change the posture least, bring the hand to the rounding of single precision. Where no branch is exact the position
counts first: the rotation gets a small weight, and none in the last steps.
"""

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from mimic.arms.capsules import Capsules
from mimic.arms.embodiment import Embodiment
from mimic.arms.pose_limits import pose_limits
from mimic.metric.distance import Metric
from mimic.metric.kinematics import LinkStates, resting_link_states
from mimic.retargeting.closed_form import ROUGH_SMOOTHING, SMOOTHING, Smoothing
from mimic.retargeting.costs import NO_COSTS, Costs, pose_cost, sum_of, with_costs
from mimic.retargeting.hand_target import (
    HandError,
    HandTarget,
    Placement,
    hand_cost_derivatives,
    hand_error,
    hands,
    in_base,
    is_exact,
    matched_hands,
    states_in_base,
)
from mimic.retargeting.initial_guesses import RandomPoses
from mimic.retargeting.multistart import Descents, kept_descents
from mimic.retargeting.optimizers import Derivatives, Scalars, newton
from mimic.retargeting.pose_objective import PoseObjective, Target, pose_objective


class Stage(NamedTuple):
    """Weights of the terms at one stage of a descent.

    Attributes:
      metric: of the embodiment distance.
      rotation: of the hand's rotation; its position has 1.
      smoothing: of the metric.
    """

    metric: Any
    rotation: Any
    smoothing: Smoothing


_ROUGH, FINE = Stage(1e-3, 1.0, ROUGH_SMOOTHING), Stage(1e-4, 1.0, SMOOTHING)
# Of poses that stand alone. With the stages and descents of motions a redundant arm is still on its way to the nearest
# posture: distances of Gen3 and Jaco are 1.2 and 1.5 % above the least known ones, with these 0.05 and 0.02 %.
_NEAREST = Stage(1e-2, 1.0, ROUGH_SMOOTHING), Stage(2e-3, 1.0, SMOOTHING)
_FINISHING = 5  # Newton steps of each stage without the metric
# Rotation's weight in these stages, 1 for hands that are exact; damping; and angles [rad] that are added at the start,
# because a straight arm is stationary and need not be nearest.
_STAGES = (1.0, 1e-4, 0.0), (1e-3, 1e-2, 0.03), (1e-3, 1e-2, 0.0), (1e-3, 1e-3, 0.0), (0.0, 1e-4, 0.0)
_WARM_STEPS = 10  # Newton steps from a warm start
_APART = 0.1  # rad, between the poses of different branches
DESCENTS, SET = Descents(18, 12), 64  # of each pose of a motion; random poses of which one is a guess
_OF_NEAREST = Descents(24, 30)
_INEXACT, _POSITION_FIRST = 1e3, 1e4  # in the order of postures: of hands that are not exact, and per m of their error


class ExactTargets(NamedTuple):
    """What the poses of a batch are solved for; batch axes last.

    Attributes:
      metric: of the objective.
      hands: of the learner.
    """

    metric: Target
    hands: HandTarget


class ExactSolver(NamedTuple):
    """The objective of a learner's exact hands.

    Attributes:
      expert, learner: the arms.
      objective: of the metric and the costs.
      pairs: [pairs, 2] of hands that match.
      costs, capsules: of postures, see `Costs`.
    """

    expert: Embodiment
    learner: Embodiment
    objective: PoseObjective
    pairs: np.ndarray
    costs: Costs
    capsules: Capsules | None

    def targets(self, base: Placement, poses: Float[Array, "poses joints"]) -> tuple[ExactTargets, Any]:
        """Targets of poses of the expert, and its link states in the axes of the learner's base."""
        states = states_in_base(base, resting_link_states(self.expert, poses.T))
        of_hands = in_base(base, hands(self.expert, [*poses.T], self.pairs[:, 0]))
        return ExactTargets(jax.vmap(self.objective.target, (-1, 0), -1)(states, poses), of_hands), states

    def derivatives(self, targets: ExactTargets) -> Callable[..., Derivatives]:
        """Derivatives for joint angles [lanes, poses], of a `Stage` given as `smoothing`."""
        of_metric = self.objective.of_batch(targets.metric)

        def weighted(qpos: Scalars, smoothing: Any = FINE) -> Derivatives:
            stage = smoothing
            metric = jax.tree.map(lambda x: stage.metric * x, of_metric(qpos, stage.smoothing))
            return sum_of(
                hand_cost_derivatives(self.learner, self.pairs[:, 1], targets.hands, qpos, stage.rotation),
                metric,
            )

        return weighted

    def errors(self, targets: ExactTargets, qpos: Float[Array, "joints *lanes poses"]) -> tuple[Array, Array]:
        """Distance [m] and angle [rad] of the hands."""
        lanes = (1,) * (qpos.ndim - 2)
        spread = jax.tree.map(lambda x: x.reshape(*x.shape[:-1], *lanes, x.shape[-1]), targets.hands)
        return hand_error(spread, hands(self.learner, [*qpos], self.pairs[:, 1]))

    def finished(self, targets: ExactTargets, qpos: Float[Array, "joints lanes poses"]) -> Array:
        """Ends of descents, with exact hands where they are near; elsewhere with the position as near as it gets."""
        limits, chosen = pose_limits(self.learner, qpos.dtype), self.pairs[:, 1]
        pattern = np.cos(np.arange(np.prod(qpos.shape[:2]))).reshape(*qpos.shape[:2], 1).astype(qpos.dtype)

        def stage(qpos: Array, of_stage: Array) -> tuple[Array, None]:
            weight, damping, kick = of_stage
            exact = is_exact(*self.errors(targets, qpos))
            rotation = jnp.where(exact, 1, weight).astype(qpos.dtype)

            def derivatives(qpos: Scalars) -> Derivatives:
                return hand_cost_derivatives(self.learner, chosen, targets.hands, qpos, rotation)

            def run(qpos: Array) -> Array:
                start = qpos + jnp.where(exact, 0, kick) * pattern
                return newton(derivatives, start, limits, _FINISHING, damping).qpos

            done = (weight < 1) & jnp.all(jnp.any(exact, axis=0))
            return jax.lax.cond(done, lambda qpos: qpos, run, qpos), None

        return jax.lax.scan(stage, qpos, jnp.asarray(_STAGES, qpos.dtype))[0]

    def branches(
        self,
        targets: ExactTargets,
        first: Float[Array, "poses joints"],
        random: RandomPoses,
        descents: Descents,
        stages: tuple[Stage, Stage] = (_ROUGH, FINE),
    ) -> Float[Array, "joints kept poses"]:
        """Postures on different branches, with hands that are nearly exact, from a first guess and random poses."""
        limits = pose_limits(self.learner, first.dtype)
        guesses = jnp.concatenate([first.T[None], self._nearest(random, targets.hands)])
        return kept_descents(self.derivatives(targets), guesses, limits, descents, stages, _APART).qpos

    def _nearest(self, random: RandomPoses, target: HandTarget) -> Float[Array, "sets joints poses"]:
        """The random pose of each set whose hand is nearest to each target."""
        hand, chosen = random.states.hand, self.pairs[:, 1]
        assert hand is not None
        shape = hand.position.shape[:2]
        position = hand.position[:, :, chosen].reshape(*shape, -1)
        axes = hand.axes.reshape(*shape, -1, 9)[:, :, chosen].reshape(*shape, -1)
        goal = target.position.reshape(-1, target.position.shape[-1]) / float(self.learner.chain_length)
        goal = jnp.concatenate([goal, target.axes.reshape(-1, goal.shape[-1])])
        # 2 |p - p^|^2 + (1 - cos theta), up to a constant of the target; rounding to TF32 does no harm here.
        table = jnp.concatenate([4 * position, axes / 2], axis=-1)
        cost = 2 * jnp.sum(position * position, -1)[..., None] - jnp.tensordot(table, goal, 1)
        index = jnp.argmin(cost, axis=1)[:, None]
        return jnp.take_along_axis(jnp.moveaxis(jnp.asarray(random.qpos), 1, -1), index, axis=-1)

    def distances(self, states: LinkStates, qpos: Float[Array, "joints lanes poses"]) -> Float[Array, "lanes poses"]:
        """Embodiment distance of each lane from the expert's link states [links, 3, poses]."""
        own = resting_link_states(self.learner, qpos.reshape(len(qpos), -1))
        own = jax.tree.map(lambda x: x.reshape(*x.shape[:2], *qpos.shape[1:]), own)
        return jax.vmap(jax.vmap(self.objective.distance, (None, -1)), (-1, -1), -1)(states, own)

    def costs_of(
        self, poses: Float[Array, "poses joints"], qpos: Float[Array, "joints lanes poses"]
    ) -> Float[Array, "lanes poses"] | float:
        """Costs of each lane, which are added to the distance."""
        if not self.costs.of_pose:
            return 0.0
        of_pose = functools.partial(pose_cost, self.costs, self.expert, self.learner, self.capsules)
        return jax.vmap(jax.vmap(of_pose, (None, -1)), (0, -1), -1)(poses, qpos)


def exact_solver(
    expert: Embodiment, learner: Embodiment, metric: Metric, costs: Costs = NO_COSTS, capsules: Capsules | None = None
) -> ExactSolver:
    """The solver of two arms, a metric, and costs of the learner's postures."""
    objective = with_costs(pose_objective(learner, metric), costs, expert, learner, capsules)
    return ExactSolver(expert, learner, objective, matched_hands(expert, learner), costs, capsules)


def exact_poses(
    solver: ExactSolver,
    base: Placement,
    poses: Float[Array, "poses joints"],
    guess: Float[Array, "poses learner_joints"],
    random: RandomPoses | None,
) -> tuple[Array, Array, HandError]:
    """Nearest postures [poses, learner_joints] with exact hands, their distances, and the errors of the hands.

    Args:
      solver: of two arms and a metric.
      base: of the learner.
      poses: of the expert.
      guess: of the postures.
      random: poses of the learner for further guesses, if any.
    """
    targets, states = solver.targets(base, poses)
    if random is None:
        limits, begin = pose_limits(solver.learner, poses.dtype), guess.astype(poses.dtype).T[:, None]
        of_targets = functools.partial(solver.derivatives(targets), smoothing=_NEAREST[1])
        near = newton(of_targets, begin, limits, _WARM_STEPS).qpos
    else:
        near = solver.branches(targets, guess, random, _OF_NEAREST, _NEAREST)
    lanes = solver.finished(targets, near)
    distance, (position, rotation) = solver.distances(states, lanes), solver.errors(targets, lanes)
    order = _rank(distance + solver.costs_of(poses, lanes), position, rotation)
    best = jnp.argmin(order, axis=0)[None]

    def chosen(values: Array) -> Array:
        index = jnp.broadcast_to(best, (*values.shape[:-2], *best.shape))
        return jnp.take_along_axis(values, index, axis=-2)[..., 0, :]

    error = HandError(chosen(position), chosen(rotation), is_exact(chosen(position), chosen(rotation)))
    return chosen(lanes).T, chosen(distance), error


def _rank(distance: Array, position: Array, rotation: Array) -> Array:
    """Order of postures: exact ones by the metric, then others by the hand's position and then its rotation."""
    inexact = _INEXACT + _POSITION_FIRST * position + rotation
    return jnp.where(is_exact(position, rotation), distance, inexact)
