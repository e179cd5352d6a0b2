"""Motion imitation: nearest poses of the learner that form a continuous motion."""

import dataclasses
import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Float

from mimic.arms.capsules import Capsules
from mimic.arms.embodiment import Embodiment
from mimic.arms.pose_limits import continuous_joints, pose_limits
from mimic.base.batches import floats
from mimic.base.compilation import compiled_once, has_tracer
from mimic.metric.distance import Correspondence, Metric, Reduction, RotationMeasure, Weights
from mimic.metric.hand import NO_HAND, HandWeights
from mimic.metric.kinematics import link_states
from mimic.retargeting.closed_form import ROUGH_SMOOTHING
from mimic.retargeting.costs import Costs, smoothness_derivatives, sum_of, with_costs
from mimic.retargeting.exact_pose import SET
from mimic.retargeting.exact_trajectory import exact_trajectories
from mimic.retargeting.hand_target import HandError, placement
from mimic.retargeting.initial_guesses import RandomPoses, initial_guesses, random_poses, typical_distance
from mimic.retargeting.optimizers import Derivatives, Scalars, Solution, newton
from mimic.retargeting.pose import (
    FLAT,
    ITERATIONS,
    STARTS,
    Hand,
    PoseImitation,
    check_count,
    check_hand,
    checked_poses,
    shared_joints,
    wrap_angles,
)
from mimic.retargeting.pose_objective import PoseObjective, Target, pose_objective

_TRACKING_ITERATIONS = 6  # Newton steps from the pose at the neighbouring time
_REFINING_ITERATIONS = 20  # of the one path that is left; with 6 a tenth of the poses were some mrad from their minimum
_LEAP = 1.5  # of the maximum change of a joint: a path that changes by more passes from one minimum to another
_ANCHORS = 3  # times with a search for minima; at the others minima are tracked


def imitate_trajectory(
    expert: Embodiment,
    learner: Embodiment,
    qpos: Float[ArrayLike, "time expert_joints"],
    correspondence: Correspondence,
    weights: Weights,
    *,
    hand: Hand = "free",
    base: Any = None,
    largest_jump: Float[ArrayLike, " learner_joints"] | float = 0.3,
    starts: int | None = None,
    key: Array | None = None,
    rotation: RotationMeasure = "cosine",
    reduction: Reduction = "mean",
    hand_weights: HandWeights = NO_HAND,
    costs: Costs | None = None,
    capsules: Capsules | None = None,
) -> PoseImitation:
    """Nearest poses that form a continuous motion: the pose at each time starts from that of the neighbouring time.

    Minima are searched at three times: the first, the middle and the last. Each minimum is tracked over the whole
    motion. The motion follows the tracks of minimum mean distance: it changes to another track where this gains more
    than the time on the way costs, in steps of at most `largest_jump`, as it also does where a minimum vanishes. It
    stays on one track where costs of collisions or of motions count, because poses on the way are not optimised. The
    first pose lies in [-pi, pi]; later, joints with a range of a full
    revolution may pass pi.

    Args:
      expert: n joints.
      learner: n_hat joints.
      qpos: [T, n] the expert's motion [rad].
      correspondence: see `embodiment_distance`.
      weights: see `embodiment_distance`; velocities are zero.
      hand: see `imitate_pose`. With exact hands the motion is exact as often as it can be within the joint ranges and
        `largest_jump`, for which give the velocity limits times the time step, and then of least mean distance.
      base: see `imitate_pose`.
      largest_jump: maximum change of a joint between two times [rad], one number or one for each joint.
      starts: see `imitate_pose`.
      key: see `imitate_pose`.
      rotation: see `embodiment_distance`.
      reduction: see `embodiment_distance`.
      hand_weights: see `embodiment_distance`.
      costs: see `Costs`; None for the embodiment distance alone. Those of velocity and acceleration are minimised pose
        by pose, each against the two poses before it. The returned distance is without costs.
      capsules: of the learner, from `fit_capsules`, for the costs of collisions.

    Raises:
      ValueError: what `imitate_pose` rejects, or a jump that is not above 0.
    """
    poses = jnp.asarray(checked_poses(expert, qpos))
    if poses.ndim != 2:
        raise ValueError(f"qpos: expected shape [time, {expert.num_joints}], got {poses.shape}")
    jump = jnp.asarray(checked_jump(learner, largest_jump), poses.dtype)
    check_hand(hand, base, expert, learner)
    starts = STARTS[hand] if starts is None else starts
    check_count("starts", starts, 0)
    costs = Costs() if costs is None else costs
    costs.check_capsules(capsules)
    metric = Metric(correspondence, weights, rotation, reduction, hand_weights)
    capsules = capsules if costs.of_capsules else None
    if hand == "exact":
        if has_tracer(poses):
            raise ValueError("qpos: expected no tracer for exact hands")
        motion, limit = np.asarray(poses, np.float32), np.asarray(jump, np.float32)
        random = random_poses(learner, key, max(starts, 1), np.float32, SET)
        arguments = placement(base), limit, random, costs, capsules
        (path,) = exact_trajectories(expert, learner, metric, [motion], *arguments)
        qpos, distance, position, angle, exact = map(jnp.asarray, path)
        return PoseImitation(qpos, distance, exact, HandError(position, angle, exact))
    solve = _trajectory_solver(expert, learner, metric, bool(starts), costs, capsules)
    return solve(poses, jump, random_poses(learner, key, max(starts, 1), poses.dtype))


def checked_jump(learner: Embodiment, largest_jump: Any) -> Float[np.ndarray, " joints"]:
    """The maximum change of each joint [rad].

    Raises:
      ValueError: neither one angle above 0 nor one for each joint.
    """
    jump = np.asarray(floats(largest_jump, "largest_jump"))
    if jump.shape not in ((), (learner.num_joints,)) or not np.all(jump > 0):
        raise ValueError(
            f"largest_jump: expected an angle above 0 rad, or {learner.num_joints}, one for each joint of "
            f"{learner.name}, got {jump.tolist()}"
        )
    return np.broadcast_to(jump, learner.num_joints)


@compiled_once
def _trajectory_solver(
    expert: Embodiment,
    learner: Embodiment,
    metric: Metric,
    random: bool,
    costs: Costs,
    capsules: Capsules | None,
) -> Callable[[Array, Array, RandomPoses], PoseImitation]:
    """The function of poses [T, n], largest jumps [n_hat] and random poses that `imitate_trajectory` compiles."""
    objective = with_costs(pose_objective(learner, metric), costs, expert, learner, capsules)

    def solve(poses: Array, jump: Array, candidates: RandomPoses) -> PoseImitation:
        anchors = np.unique(np.linspace(0, poses.shape[0] - 1, _ANCHORS).round().astype(int))
        states = jax.vmap(lambda pose: link_states(expert, pose))(poses)
        targets = jax.vmap(objective.target)(states, poses)
        scale = typical_distance(objective, jax.tree.map(lambda x: x[0], targets), candidates)
        tracker = _Tracker(objective, targets, pose_limits(learner, poses.dtype), jump, len(poses), costs)

        def from_anchor(anchor: Array) -> Solution:
            target = jax.tree.map(lambda x: x[anchor], targets)
            first = shared_joints(expert, learner, poses[anchor])
            guesses = initial_guesses(objective, target, first, candidates if random else None)
            return jax.vmap(lambda guess: tracker.track(anchor, guess))(guesses)

        tracks = jax.vmap(from_anchor)(jnp.asarray(anchors))
        tracks = jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), tracks)
        if costs.of_motion or costs.of_capsules:
            path = tracks.qpos[jnp.argmin(tracks.value.mean(axis=1))]
        else:
            path = _best_path(tracks, jump, continuous_joints(learner), scale)
        solution = tracker.refine(path)
        distance = jax.vmap(lambda state, q: objective.distance(state, link_states(learner, q)))(states, solution.qpos)
        shift = wrap_angles(solution.qpos[0], continuous_joints(learner)) - solution.qpos[0]
        return PoseImitation(solution.qpos + shift, distance, solution.gradient_norm <= FLAT * scale)

    return solve


def _best_path(
    tracks: Solution, jump: Float[Array, " joints"], continuous: np.ndarray, cost_of_step: Array
) -> Float[Array, "time joints"]:
    """Poses on the tracks [tracks, time] with the minimum sum of values and changes of track, by dynamic programming.

    A change costs as much for each step on the way as a random pose.
    """
    every = jnp.arange(len(tracks.value))

    def advance(total: Array, now: tuple[Array, Array]) -> tuple[Array, Array]:
        qpos, value = now
        apart = wrap_angles(qpos[:, None] - qpos, continuous)
        steps = jnp.ceil(jnp.max(jnp.abs(apart) / jump, axis=-1))
        steps = jnp.where(every[:, None] == every, 0.0, jnp.maximum(steps, 1.0))
        through = total[:, None] + cost_of_step * steps
        return value + through.min(axis=0), through.argmin(axis=0)

    over_time = jnp.swapaxes(tracks.qpos, 0, 1), tracks.value.T
    total, previous = jax.lax.scan(advance, jnp.zeros_like(tracks.value[:, 0]), over_time)
    last = jnp.argmin(total)
    _, followed = jax.lax.scan(lambda track, before: (before[track], track), last, previous, reverse=True)
    return over_time[0][jnp.arange(len(followed)), followed]


_Past = tuple[Array, Array]  # the previous pose, and the one before it


@dataclasses.dataclass(frozen=True)
class _Tracker:
    """Tracks minima over the times of a trajectory.

    Attributes:
      objective: of the learner.
      targets: of all times.
      limits: of the joints [rad].
      jump: maximum change of each joint between two times [rad].
      times: number of times.
      costs: those of motions.
    """

    objective: PoseObjective
    targets: Target
    limits: tuple[np.ndarray, np.ndarray]
    jump: Float[Array, " joints"]
    times: int
    costs: Costs

    def track(self, anchor: Array, guess: Array) -> Solution:
        """The minimum near a guess at the anchor's time, tracked over all times with the rough derivatives."""
        rough = functools.partial(self.objective.derivatives, smoothing=ROUGH_SMOOTHING)
        begin = newton(self._at(rough, anchor), guess, self.limits, ITERATIONS).qpos

        def follow(past: _Past, time: Array) -> tuple[_Past, Solution]:
            solution = self._near(rough, past, past[0], time, _TRACKING_ITERATIONS)
            return (solution.qpos, past[0]), solution

        # From the anchor to the end, then back over all times, which also covers those before the anchor.
        times = jnp.arange(self.times)
        path = jnp.concatenate([jnp.maximum(times, anchor), times[::-1]])
        solutions = jax.lax.scan(follow, (begin, begin), path)[1]
        return jax.tree.map(lambda x: x[: self.times - 1 : -1], solutions)

    def refine(self, path: Float[Array, "time joints"]) -> Solution:
        """A path, optimised with the exact derivatives; where it leaps, in steps of at most `jump` without these."""

        def follow(past: _Past, guess_and_time: tuple[Array, Array]) -> tuple[_Past, Solution]:
            guess, time = guess_and_time
            lower, upper = self.limits
            endless = np.isinf(lower) & np.isinf(upper)
            guess = wrap_angles(guess, endless, centre=past[0])
            reached = jnp.clip(guess, past[0] - self.jump, past[0] + self.jump)
            solution = self._near(self.objective.derivatives, past, reached, time, _REFINING_ITERATIONS)
            leaps = jnp.any(jnp.abs(guess - past[0]) > _LEAP * self.jump)
            on_the_way = Solution(reached, solution.value, jnp.inf * solution.value)
            solution = jax.tree.map(lambda x, y: jnp.where(leaps, x, y), on_the_way, solution)
            return (solution.qpos, past[0]), solution

        return jax.lax.scan(follow, (path[0], path[0]), (path, jnp.arange(self.times)))[1]

    def _at(self, derivatives: Callable[..., Derivatives], time: Array) -> Callable[..., Derivatives]:
        return functools.partial(derivatives, jax.tree.map(lambda x: x[time], self.targets))

    def _near(
        self, derivatives: Callable[..., Derivatives], past: _Past, guess: Array, time: Array, iterations: int
    ) -> Solution:
        lower, upper = self.limits
        previous, earlier = past
        reachable = jnp.maximum(lower, previous - self.jump), jnp.minimum(upper, previous + self.jump)
        of_pose = self._at(derivatives, time)

        def of_motion(qpos: Scalars) -> Derivatives:
            return sum_of(of_pose(qpos), smoothness_derivatives(self.costs, qpos, previous, earlier))

        return newton(of_motion if self.costs.of_motion else of_pose, guess, reachable, iterations)
