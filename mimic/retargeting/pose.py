"""Static pose imitation: the learner's pose that is nearest to a pose of the expert."""

import functools
from collections.abc import Callable
from typing import Any, Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jax.typing import ArrayLike
from jaxtyping import Array, Bool, Float

from mimic.arms.embodiment import Embodiment
from mimic.metric.distance import Correspondence, Metric, Reduction, RotationMeasure, Weights
from mimic.metric.kinematics import LinkStates, link_states
from mimic.retargeting.optimizers import Derivatives, Scalars, Solution, gradient_descent, newton
from mimic.retargeting.pose_objective import PoseObjective, Target, pose_objective

Method = Literal["newton", "gradient_descent"]
METHODS = ("newton", "gradient_descent")

_ITERATIONS = {"newton": 16, "gradient_descent": 1000}
_TRACKING_ITERATIONS = 6  # Newton steps from the pose of the neighbouring time
_ROUGH_SHARE = 0.35  # all starts descend for this share of the iterations, then the best of them
_POSES = 256  # random poses that are compared, without a descent, to find the starts
_FLAT = 1e-3  # gradient [1/rad] of a pose that counts as converged, as a share of the mean distance of random poses
_ANCHORS = 3  # times of a trajectory at which minima are searched; all others are tracked


class PoseImitation(NamedTuple):
    """The learner's nearest poses.

    Attributes:
      qpos: [*batch, learner_joints] angles [rad].
      distance: [*batch] embodiment distance that is left.
      converged: [*batch] whether the gradient vanishes there, but for joints that are held at a limit. Where positions
        match, a kink of the distance, it is the gradient of the smoothed one (see `mimic.retargeting.closed_form`).
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
    """The learner's pose of least embodiment distance, argmin d(s(q), s_hat(q_hat)) (paper, eq. 22).

    The distance has local minima, so several descents are made for each pose: from the expert's own angles in the
    joints that both arms have by name, and from the nearest of each of `starts` sets of random poses. The best end
    is returned. "newton" is a damped Newton method on the exact second derivative, with concave directions turned
    round; "gradient_descent" is the paper's plain descent with a constant step.

    Jit what calls this if it is called more than once; each call of its own is compiled anew.

    Args:
      expert: n joints.
      learner: its n_hat joints are optimised, within their range; a joint that can do a full turn ends in [-pi, pi].
      qpos: [n] or [..., n] the expert's poses [rad].
      correspondence: see `embodiment_distance`.
      weights: see `embodiment_distance`; velocities are zero.
      starts: descents from random poses; 0 leaves the expert's own angles.
      key: of the random poses; `jax.random.key(0)` where None.
      warm_start: [..., n_hat] the only start, where it is given.
      method: "newton" or "gradient_descent".
      iterations: of each descent; 16 for Newton's method, 1000 for gradient descent where None.
      kept: descents that go on after a third of the iterations, the best so far. None keeps all, which is twice the
        work, but half as much to compile.
      rotation: see `embodiment_distance`.
      reduction: see `embodiment_distance`.

    Raises:
      ValueError: poses of the wrong shape or not finite, an unknown method, or counts below their least value.
    """
    poses = _checked_poses(expert, qpos, "qpos")
    if method not in METHODS:
        raise ValueError(f"method: expected one of {', '.join(METHODS)}, got {method!r}")
    count = _ITERATIONS[method] if iterations is None else iterations
    if starts < 0 or count < 2:
        raise ValueError(f"starts, iterations: expected at least 0 and 2, got {starts} and {count}")
    if kept is not None and kept < 1:
        raise ValueError(f"kept: expected at least 1, or None for all, got {kept}")
    rough = count if kept is None else max(int(_ROUGH_SHARE * count), 1)
    key = jax.random.key(0) if key is None else key
    batch = poses.shape[:-1]
    objective = pose_objective(learner, Metric(correspondence, weights, rotation, reduction))
    limits = pose_limits(learner, poses.dtype)
    descend = newton if method == "newton" else gradient_descent

    def solve(poses: Array, warm: Array | None) -> PoseImitation:
        tried = _random_poses(learner, key, max(starts, 1), poses.dtype)
        scale = _typical_distance(objective, expert, poses, tried)

        def one(pose: Array, warm: Array | None) -> PoseImitation:
            states = link_states(expert, pose)
            target = objective.target(states)
            first = _starts(objective, expert, learner, target, pose, tried if starts else None)
            first = first if warm is None else warm[None]
            of_qpos = functools.partial(objective.derivatives, target)
            rough_of_qpos = of_qpos if kept is None else functools.partial(objective.rough_derivatives, target)
            ends = jax.vmap(lambda start: descend(rough_of_qpos, start, limits, rough))(first)
            if kept is not None:
                chosen = jax.lax.top_k(-ends.value, min(kept, len(first)))[1]
                ends = jax.vmap(lambda start: descend(of_qpos, start, limits, count - rough))(ends.qpos[chosen])
            end: Solution = jax.tree.map(lambda x: x[jnp.argmin(ends.value)], ends)
            left = objective.distance(states, link_states(learner, end.qpos))
            return PoseImitation(_wrapped(end.qpos, limits), left, end.gradient_norm <= _FLAT * scale)

        in_axes = (0, None if warm is None else 0)
        return jax.vmap(one, in_axes)(poses, warm)

    flat_warm = None
    if warm_start is not None:
        flat_warm = _checked_poses(learner, warm_start, "warm_start").reshape(-1, learner.num_joints)
        flat_warm = jnp.broadcast_to(flat_warm, (int(np.prod(batch)), learner.num_joints))
    found = jax.jit(solve)(poses.reshape(-1, expert.num_joints), flat_warm)
    return jax.tree.map(lambda x: x.reshape(*batch, *x.shape[1:]), found)


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
    """Nearest poses that form one continuous motion: each time starts from its neighbour's pose.

    Minima are searched at three times, the first, middle and last; each minimum is tracked over the whole motion, and
    the track of the least mean distance is returned. Where a minimum vanishes, the joints move on to another at their
    largest jump. The first pose lies in [-pi, pi]; then a joint that can do a full turn may pass pi.

    Args:
      expert: n joints.
      learner: n_hat joints.
      qpos: [T, n] the expert's motion [rad].
      correspondence: see `embodiment_distance`.
      weights: see `embodiment_distance`; velocities are zero.
      largest_jump: bound on the change of a joint between two times [rad], one number or one for each joint.
      starts: see `imitate_pose`.
      key: see `imitate_pose`.
      rotation: see `embodiment_distance`.
      reduction: see `embodiment_distance`.

    Raises:
      ValueError: what `imitate_pose` refuses, or a jump that is not above 0.
    """
    poses = _checked_poses(expert, qpos, "qpos")
    if poses.ndim != 2:
        raise ValueError(f"qpos: expected shape [time, {expert.num_joints}], got {poses.shape}")
    if not np.all(np.asarray(largest_jump) > 0):
        raise ValueError(f"largest_jump: expected angles above 0 rad, got {largest_jump}")
    if starts < 0:
        raise ValueError(f"starts: expected at least 0, got {starts}")
    key = jax.random.key(0) if key is None else key
    objective = pose_objective(learner, Metric(correspondence, weights, rotation, reduction))
    limits = lower, upper = pose_limits(learner, poses.dtype)
    jump = jnp.broadcast_to(jnp.asarray(largest_jump, poses.dtype), (learner.num_joints,))
    last = poses.shape[0] - 1
    anchors = np.unique(np.linspace(0, last, _ANCHORS).round().astype(int))

    def solve(poses: Array) -> PoseImitation:
        tried = _random_poses(learner, key, max(starts, 1), poses.dtype)
        scale = _typical_distance(objective, expert, poses, tried)
        states = jax.vmap(lambda pose: link_states(expert, pose))(poses)
        targets = jax.vmap(objective.target)(states)

        def at(derivatives: Callable[..., Derivatives], time: Array) -> Callable[[Scalars], Derivatives]:
            return functools.partial(derivatives, jax.tree.map(lambda x: x[time], targets))

        def near(derivatives: Callable[..., Derivatives], previous: Array, start: Array, time: Array) -> Solution:
            reach = jnp.maximum(lower, previous - jump), jnp.minimum(upper, previous + jump)
            return newton(at(derivatives, time), start, reach, _TRACKING_ITERATIONS)

        def track(anchor: Array, start: Array) -> Solution:
            rough = objective.rough_derivatives
            begin = newton(at(rough, anchor), start, limits, _ITERATIONS["newton"]).qpos

            def follow(pose: Array, time: Array) -> tuple[Array, Solution]:
                end = near(rough, pose, pose, time)
                return end.qpos, end

            # Forth from the anchor to the end, then back over all: what lies before the anchor is reached that way too.
            times = jnp.arange(last + 1)
            ends = jax.lax.scan(follow, begin, jnp.concatenate([jnp.maximum(times, anchor), times[::-1]]))[1]
            return jax.tree.map(lambda x: x[:last:-1], ends)

        def refined(rough: Solution) -> Solution:
            """The same track, by the derivatives that count."""

            def follow(pose: Array, at_time: tuple[Array, Array]) -> tuple[Array, Solution]:
                start, time = at_time
                end = near(objective.derivatives, pose, start, time)
                return end.qpos, end

            return jax.lax.scan(follow, rough.qpos[0], (rough.qpos, jnp.arange(last + 1)))[1]

        def from_anchor(anchor: Array) -> Solution:
            target = jax.tree.map(lambda x: x[anchor], targets)
            first = _starts(objective, expert, learner, target, poses[anchor], tried if starts else None)
            return jax.vmap(lambda start: track(anchor, start))(first)

        tracks = jax.vmap(from_anchor)(jnp.asarray(anchors))
        tracks = jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), tracks)
        best = jnp.argmin(tracks.value.mean(axis=1))
        found: Solution = jax.tree.map(lambda x: x[best], tracks)
        if objective.rough_derivatives is not objective.derivatives:
            found = refined(found)
        left = jax.vmap(lambda state, q: objective.distance(state, link_states(learner, q)))(states, found.qpos)
        shift = _wrapped(found.qpos[0], limits) - found.qpos[0]
        return PoseImitation(found.qpos + shift, left, found.gradient_norm <= _FLAT * scale)

    return jax.jit(solve)(poses)


def pose_limits(arm: Embodiment, dtype: Any) -> tuple[np.ndarray, np.ndarray]:
    """Joint ranges, lower and upper; infinite for a joint that can do a full turn."""
    lower, upper = np.asarray(arm.joint_range).T
    full = upper - lower >= 2 * np.pi - 1e-4  # a model's text rounds pi
    return np.where(full, -np.inf, lower).astype(dtype), np.where(full, np.inf, upper).astype(dtype)


def shared_joints(
    expert: Embodiment, learner: Embodiment, values: Float[Any, "*batch expert_joints"]
) -> Float[Any, "*batch learner_joints"]:
    """The expert's values in the joints that both arms have by name, zero in the learner's others."""
    names = expert.joint_names
    index = np.array([names.index(name) if name in names else -1 for name in learner.joint_names])
    library = np if isinstance(values, np.ndarray) else jnp
    return library.where(index >= 0, values[..., index], 0)


def _checked_poses(arm: Embodiment, values: ArrayLike, name: str) -> Array:
    poses = jnp.asarray(values)
    if poses.ndim < 1 or poses.shape[-1] != arm.num_joints:
        raise ValueError(f"{name}: expected shape [..., {arm.num_joints}] for {arm.name}, got {poses.shape}")
    poses = poses if jnp.issubdtype(poses.dtype, jnp.floating) else poses.astype(float)
    if not isinstance(poses, Tracer) and not np.all(np.isfinite(np.asarray(poses))):
        raise ValueError(f"{name}: expected finite angles [rad], got some that are not")
    return poses


class RandomPoses(NamedTuple):
    """Poses of the learner that are compared, without a descent.

    Attributes:
      qpos: [sets, poses, joints] [rad].
      states: their link states, [sets, poses, links, 3] each.
    """

    qpos: Float[Array, "sets poses joints"]
    states: LinkStates


def _random_poses(arm: Embodiment, key: Array, sets: int, dtype: Any) -> RandomPoses:
    lower, upper = jnp.asarray(arm.joint_range, dtype).T
    shape = (sets, -(-_POSES // sets), arm.num_joints)
    qpos = jax.random.uniform(key, shape, dtype, minval=lower, maxval=upper)
    return RandomPoses(qpos, jax.vmap(jax.vmap(lambda q: link_states(arm, q)))(qpos))


def _typical_distance(
    objective: PoseObjective, expert: Embodiment, poses: Array, tried: RandomPoses
) -> Float[Array, ""]:
    """Mean distance of random poses to one of the expert's: the scale of the metric."""
    states = link_states(expert, poses.reshape(-1, expert.num_joints)[0])
    return jax.vmap(jax.vmap(lambda own: objective.distance(states, own)))(tried.states).mean()


def _starts(
    objective: PoseObjective,
    expert: Embodiment,
    learner: Embodiment,
    target: Target,
    expert_qpos: Array,
    tried: RandomPoses | None,
) -> Float[Array, "starts joints"]:
    """The expert's angles in the joints that both arms have by name, then the nearest of each set of random poses."""
    own = shared_joints(expert, learner, expert_qpos)
    if tried is None:
        return own[None]
    values = jax.vmap(jax.vmap(lambda states: objective.value(target, states)))(tried.states)
    nearest = jnp.take_along_axis(tried.qpos, jnp.argmin(values, axis=1)[:, None, None], axis=1)[:, 0]
    return jnp.concatenate([own[None], nearest])


def _wrapped(qpos: Array, limits: tuple[np.ndarray, np.ndarray]) -> Array:
    """Joints that can do a full turn, in [-pi, pi]."""
    return jnp.where(np.isinf(limits[0]), qpos - 2 * jnp.pi * jnp.round(qpos / (2 * jnp.pi)), qpos)
