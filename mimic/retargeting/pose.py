"""Static pose imitation (pose retargeting): the learner's pose nearest to a pose of the expert."""

import dataclasses
import functools
from collections.abc import Callable, Sequence
from typing import Any, Literal, NamedTuple, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jax.typing import ArrayLike
from jaxtyping import Array, Bool, Float

from mimic.arms.embodiment import Embodiment
from mimic.config import check_choice
from mimic.metric.distance import Correspondence, Metric, Reduction, RotationMeasure, Weights
from mimic.metric.kinematics import LinkStates, link_states
from mimic.metric.spatial import array_library
from mimic.retargeting.optimizers import Derivatives, Scalars, Solution, gradient_descent, newton
from mimic.retargeting.pose_objective import PoseObjective, Target, pose_objective

Method = Literal["newton", "gradient_descent"]
METHODS = ("newton", "gradient_descent")
AnyArray = TypeVar("AnyArray", Array, np.ndarray)

_ITERATIONS = {"newton": 16, "gradient_descent": 1000}
_TRACKING_ITERATIONS = 6  # Newton steps from the pose at the neighbouring time
_ROUGH_FRACTION = 0.35  # of the iterations, for descents from all initial guesses; the best ones get the others
_POSES = 256  # random poses whose distances are compared to choose the initial guesses
_FLAT = 1e-3  # gradient [1/rad] of a converged pose, as a fraction of the mean distance of random poses
_ANCHORS = 3  # times of a trajectory with a search for minima; at the others minima are tracked


class PoseImitation(NamedTuple):
    """Nearest poses of the learner.

    Attributes:
      qpos: [*batch, learner_joints] angles [rad].
      distance: [*batch] embodiment distance at these poses.
      converged: [*batch] whether the gradient vanishes, apart from joints at a limit. Matching positions are a kink of
        the distance; there it is the gradient of the smoothed distance (see `mimic.retargeting.closed_form`).
    """

    qpos: Float[Array, "*batch learner_joints"]
    distance: Float[Array, "*batch"]
    converged: Bool[Array, "*batch"]


def imitate_pose(
    expert: Embodiment,
    learner: Embodiment,
    qpos: Float[ArrayLike, "*batch expert_joints"],
    correspondence: Correspondence,
    weights: Weights,
    *,
    starts: int = 12,
    key: Array | None = None,
    warm_start: Float[ArrayLike, "*batch learner_joints"] | None = None,
    method: Method = "newton",
    iterations: int | None = None,
    kept: int | None = 2,
    rotation: RotationMeasure = "cosine",
    reduction: Reduction = "mean",
) -> PoseImitation:
    """Learner pose of minimum embodiment distance to an expert pose, argmin d(s(q), s_hat(q_hat)) (paper, eq. 22).

    The distance has local minima, so each pose is optimised from several initial guesses: the expert's angles in the
    joints that both arms have by name, and the nearest pose of each of `starts` sets of random poses. The best result
    is returned. "newton" is a damped Newton method on the exact second derivative with negative curvature flipped
    (saddle-free Newton); "gradient_descent" is the paper's descent with a constant step.

    Each call compiles again: to call it repeatedly, wrap the caller in `jax.jit`.

    Args:
      expert: n joints.
      learner: n_hat joints, optimised within their ranges; joints with a range of a full revolution end in [-pi, pi].
      qpos: [n] or [..., n] the expert's poses [rad].
      correspondence: see `embodiment_distance`.
      weights: see `embodiment_distance`; velocities are zero.
      starts: number of random initial guesses; with 0 the expert's angles are the only one.
      key: of the random poses; `jax.random.key(0)` where None.
      warm_start: [..., n_hat] replaces all initial guesses.
      method: "newton" or "gradient_descent".
      iterations: of each descent; where None, 16 for Newton's method and 1000 for gradient descent.
      kept: number of best descents that continue after a third of the iterations. None continues all, which doubles
        the computation but halves the compilation.
      rotation: see `embodiment_distance`.
      reduction: see `embodiment_distance`.

    Raises:
      ValueError: poses of the wrong shape or not finite, an unknown method, or a count below its minimum.
    """
    poses = checked_poses(expert, jnp.asarray(qpos))
    check_choice("method", method, METHODS)
    # Longer than 40 lines: argument checks, and functions that share the arguments.
    count = _ITERATIONS[method] if iterations is None else iterations
    if starts < 0 or count < 2:
        raise ValueError(f"starts, iterations: expected at least 0 and 2, got {starts} and {count}")
    if kept is not None and kept < 1:
        raise ValueError(f"kept: expected at least 1, or None for all, got {kept}")
    key = jax.random.key(0) if key is None else key
    batch = poses.shape[:-1]
    objective = pose_objective(learner, Metric(correspondence, weights, rotation, reduction))
    limits, continuous = pose_limits(learner, poses.dtype), continuous_joints(learner)

    def solve(poses: Array, warm: Array | None) -> PoseImitation:
        random_poses = _random_poses(learner, key, max(starts, 1), poses.dtype)
        scale = _typical_distance(objective, expert, poses, random_poses)

        def solve_pose(pose: Array, warm: Array | None) -> PoseImitation:
            states = link_states(expert, pose)
            target = objective.target(states)
            guesses = _initial_guesses(objective, expert, learner, target, pose, random_poses if starts else None)
            guesses = guesses if warm is None else warm[None]
            solution = _minimise(objective, target, guesses, limits, method, count, kept)
            distance = objective.distance(states, link_states(learner, solution.qpos))
            is_flat = solution.gradient_norm <= _FLAT * scale
            return PoseImitation(wrap_angles(solution.qpos, continuous), distance, is_flat)

        in_axes = (0, None if warm is None else 0)
        return jax.vmap(solve_pose, in_axes)(poses, warm)

    flat_warm = None
    if warm_start is not None:
        flat_warm = checked_poses(learner, jnp.asarray(warm_start), "warm_start").reshape(-1, learner.num_joints)
        flat_warm = jnp.broadcast_to(flat_warm, (int(np.prod(batch)), learner.num_joints))
    solutions = jax.jit(solve)(poses.reshape(-1, expert.num_joints), flat_warm)
    return jax.tree.map(lambda x: x.reshape(*batch, *x.shape[1:]), solutions)


def _minimise(
    objective: PoseObjective,
    target: Target,
    guesses: Float[Array, "guesses joints"],
    limits: tuple[np.ndarray, np.ndarray],
    method: Method,
    iterations: int,
    kept: int | None,
) -> Solution:
    """The best of the descents from all guesses, of which `kept` continue after the rough iterations."""
    descend = newton if method == "newton" else gradient_descent
    rough = iterations if kept is None else max(int(_ROUGH_FRACTION * iterations), 1)
    of_qpos = functools.partial(objective.derivatives, target)
    rough_of_qpos = of_qpos if kept is None else functools.partial(objective.rough_derivatives, target)
    solutions = jax.vmap(lambda guess: descend(rough_of_qpos, guess, limits, rough))(guesses)
    if kept is not None:
        best = jax.lax.top_k(-solutions.value, min(kept, len(guesses)))[1]
        solutions = jax.vmap(lambda guess: descend(of_qpos, guess, limits, iterations - rough))(solutions.qpos[best])
    return jax.tree.map(lambda x: x[jnp.argmin(solutions.value)], solutions)


def imitate_trajectory(
    expert: Embodiment,
    learner: Embodiment,
    qpos: Float[ArrayLike, "time expert_joints"],
    correspondence: Correspondence,
    weights: Weights,
    *,
    largest_jump: Float[ArrayLike, " learner_joints"] | float = 0.3,
    starts: int = 12,
    key: Array | None = None,
    rotation: RotationMeasure = "cosine",
    reduction: Reduction = "mean",
) -> PoseImitation:
    """Nearest poses that form a continuous motion: the pose at each time starts from that of the neighbouring time.

    Minima are searched at three times: the first, the middle and the last. Each minimum is tracked over the whole
    motion, and the track of minimum mean distance is returned. Where a minimum vanishes, the joints move to another one
    in steps of at most `largest_jump`. The first pose lies in [-pi, pi]; later, joints with a range of a full
    revolution may pass pi.

    Args:
      expert: n joints.
      learner: n_hat joints.
      qpos: [T, n] the expert's motion [rad].
      correspondence: see `embodiment_distance`.
      weights: see `embodiment_distance`; velocities are zero.
      largest_jump: maximum change of a joint between two times [rad], one number or one for each joint.
      starts: see `imitate_pose`.
      key: see `imitate_pose`.
      rotation: see `embodiment_distance`.
      reduction: see `embodiment_distance`.

    Raises:
      ValueError: what `imitate_pose` rejects, or a jump that is not above 0.
    """
    # Longer than 40 lines: argument checks, and functions that share the arguments.
    poses = checked_poses(expert, jnp.asarray(qpos))
    if poses.ndim != 2:
        raise ValueError(f"qpos: expected shape [time, {expert.num_joints}], got {poses.shape}")
    if not np.all(np.asarray(largest_jump) > 0):
        raise ValueError(f"largest_jump: expected angles above 0 rad, got {largest_jump}")
    if starts < 0:
        raise ValueError(f"starts: expected at least 0, got {starts}")
    key = jax.random.key(0) if key is None else key
    objective = pose_objective(learner, Metric(correspondence, weights, rotation, reduction))
    limits = pose_limits(learner, poses.dtype)
    jump = jnp.broadcast_to(jnp.asarray(largest_jump, poses.dtype), (learner.num_joints,))
    anchors = np.unique(np.linspace(0, poses.shape[0] - 1, _ANCHORS).round().astype(int))

    def solve(poses: Array) -> PoseImitation:
        random_poses = _random_poses(learner, key, max(starts, 1), poses.dtype)
        scale = _typical_distance(objective, expert, poses, random_poses)
        states = jax.vmap(lambda pose: link_states(expert, pose))(poses)
        targets = jax.vmap(objective.target)(states)
        tracker = _Tracker(objective, targets, limits, jump, times=len(poses))

        def from_anchor(anchor: Array) -> Solution:
            target = jax.tree.map(lambda x: x[anchor], targets)
            candidates = random_poses if starts else None
            guesses = _initial_guesses(objective, expert, learner, target, poses[anchor], candidates)
            return jax.vmap(lambda guess: tracker.track(anchor, guess))(guesses)

        tracks = jax.vmap(from_anchor)(jnp.asarray(anchors))
        tracks = jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), tracks)
        best = jnp.argmin(tracks.value.mean(axis=1))
        solution: Solution = jax.tree.map(lambda x: x[best], tracks)
        if objective.rough_derivatives is not objective.derivatives:
            solution = tracker.refine(solution)
        distance = jax.vmap(lambda state, q: objective.distance(state, link_states(learner, q)))(states, solution.qpos)
        shift = wrap_angles(solution.qpos[0], continuous_joints(learner)) - solution.qpos[0]
        return PoseImitation(solution.qpos + shift, distance, solution.gradient_norm <= _FLAT * scale)

    return jax.jit(solve)(poses)


@dataclasses.dataclass(frozen=True)
class _Tracker:
    """Tracks minima over the times of a trajectory.

    Attributes:
      objective: of the learner.
      targets: of all times.
      limits: of the joints [rad].
      jump: maximum change of each joint between two times [rad].
      times: number of times.
    """

    objective: PoseObjective
    targets: Target
    limits: tuple[Array | np.ndarray, Array | np.ndarray]
    jump: Float[Array, " joints"]
    times: int

    def track(self, anchor: Array, guess: Array) -> Solution:
        """The minimum near a guess at the anchor's time, tracked over all times with the rough derivatives."""
        rough = self.objective.rough_derivatives
        begin = newton(self._at(rough, anchor), guess, self.limits, _ITERATIONS["newton"]).qpos

        def follow(pose: Array, time: Array) -> tuple[Array, Solution]:
            solution = self._near(rough, pose, pose, time)
            return solution.qpos, solution

        # From the anchor to the end, then back over all times, which also covers those before the anchor.
        times = jnp.arange(self.times)
        path = jnp.concatenate([jnp.maximum(times, anchor), times[::-1]])
        solutions = jax.lax.scan(follow, begin, path)[1]
        return jax.tree.map(lambda x: x[: self.times - 1 : -1], solutions)

    def refine(self, rough: Solution) -> Solution:
        """A track, optimised with the exact derivatives."""

        def follow(pose: Array, guess_and_time: tuple[Array, Array]) -> tuple[Array, Solution]:
            guess, time = guess_and_time
            solution = self._near(self.objective.derivatives, pose, guess, time)
            return solution.qpos, solution

        return jax.lax.scan(follow, rough.qpos[0], (rough.qpos, jnp.arange(self.times)))[1]

    def _at(self, derivatives: Callable[..., Derivatives], time: Array) -> Callable[[Scalars], Derivatives]:
        return functools.partial(derivatives, jax.tree.map(lambda x: x[time], self.targets))

    def _near(self, derivatives: Callable[..., Derivatives], previous: Array, guess: Array, time: Array) -> Solution:
        lower, upper = self.limits
        reachable = jnp.maximum(lower, previous - self.jump), jnp.minimum(upper, previous + self.jump)
        return newton(self._at(derivatives, time), guess, reachable, _TRACKING_ITERATIONS)


def pose_limits(arm: Embodiment, dtype: Any) -> tuple[np.ndarray, np.ndarray]:
    """Lower and upper joint limits [rad]; infinite for `continuous_joints`."""
    lower, upper = np.asarray(arm.joint_range).T
    continuous = continuous_joints(arm)
    return np.where(continuous, -np.inf, lower).astype(dtype), np.where(continuous, np.inf, upper).astype(dtype)


def continuous_joints(arm: Embodiment) -> Bool[np.ndarray, " joints"]:
    """Which joints can rotate by a full revolution: their range is 2 pi or more."""
    lower, upper = np.asarray(arm.joint_range).T
    return upper - lower >= 2 * np.pi - 1e-4  # models round pi in their text


def wrap_angles(angles: Float[Any, "*batch joints"], where: Any = True, *, centre: Any = 0.0) -> Any:
    """Angles shifted by full revolutions into [centre - pi, centre + pi].

    Args:
      angles: NumPy or JAX array [rad].
      where: joints that are wrapped; all by default.
      centre: middle of the interval [rad].
    """
    numpy = array_library(angles)
    return numpy.where(where, angles - 2 * np.pi * numpy.round((angles - centre) / (2 * np.pi)), angles)


def shared_joints(
    expert: Embodiment, learner: Embodiment, values: Float[Any, "*batch expert_joints"]
) -> Float[Any, "*batch learner_joints"]:
    """The expert's values in the joints that both arms have by name; zero in the learner's other joints."""
    names = expert.joint_names
    index = np.array([names.index(name) if name in names else -1 for name in learner.joint_names])
    return array_library(values).where(index >= 0, values[..., index], 0)


def checked_poses(arm: Embodiment, poses: AnyArray, name: str = "qpos", *, axes: Sequence[str] = ()) -> AnyArray:
    """The poses as floating-point numbers.

    Args:
      arm: the embodiment.
      poses: joint angles [rad], NumPy or JAX array.
      name: of the argument, for the error.
      axes: names of the required axes before that of the joints.

    Raises:
      ValueError: the shape is not [..., *axes, joints], or an angle is not finite.
    """
    if poses.ndim <= len(axes) or poses.shape[-1] != arm.num_joints:
        shape = ", ".join(["...", *axes, str(arm.num_joints)])
        raise ValueError(f"{name}: expected shape [{shape}] for {arm.name}, got {poses.shape}")
    poses = poses if jnp.issubdtype(poses.dtype, jnp.floating) else poses.astype(float)
    if not isinstance(poses, Tracer) and not np.all(np.isfinite(np.asarray(poses))):
        raise ValueError(f"{name}: expected finite angles [rad], got some that are not")
    return poses


class RandomPoses(NamedTuple):
    """Random poses of the learner, candidates for initial guesses.

    Attributes:
      qpos: [sets, poses, joints] [rad].
      states: link states of these poses, each [sets, poses, links, 3].
    """

    qpos: Float[Array, "sets poses joints"]
    states: LinkStates


def _random_poses(arm: Embodiment, key: Array, sets: int, dtype: Any) -> RandomPoses:
    lower, upper = jnp.asarray(arm.joint_range, dtype).T
    shape = (sets, -(-_POSES // sets), arm.num_joints)
    qpos = jax.random.uniform(key, shape, dtype, minval=lower, maxval=upper)
    return RandomPoses(qpos, jax.vmap(jax.vmap(lambda q: link_states(arm, q)))(qpos))


def _typical_distance(
    objective: PoseObjective, expert: Embodiment, poses: Array, random_poses: RandomPoses
) -> Float[Array, ""]:
    """Mean distance of random poses to a pose of the expert: the scale of the metric."""
    states = link_states(expert, poses.reshape(-1, expert.num_joints)[0])
    return jax.vmap(jax.vmap(lambda learner_states: objective.distance(states, learner_states)))(
        random_poses.states
    ).mean()


def _initial_guesses(
    objective: PoseObjective,
    expert: Embodiment,
    learner: Embodiment,
    target: Target,
    expert_qpos: Array,
    random_poses: RandomPoses | None,
) -> Float[Array, "guesses joints"]:
    """The expert's angles in the joints that both arms have by name, then the nearest of each set of random poses."""
    expert_guess = shared_joints(expert, learner, expert_qpos)
    if random_poses is None:
        return expert_guess[None]
    values = jax.vmap(jax.vmap(lambda states: objective.value(target, states)))(random_poses.states)
    nearest = jnp.take_along_axis(random_poses.qpos, jnp.argmin(values, axis=1)[:, None, None], axis=1)[:, 0]
    return jnp.concatenate([expert_guess[None], nearest])
