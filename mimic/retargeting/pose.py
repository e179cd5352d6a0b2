"""Static pose imitation (pose retargeting): the learner's pose nearest to a pose of the expert."""

import functools
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jax.typing import ArrayLike
from jaxtyping import Array, Bool, Float

from mimic.arms.capsules import Capsules
from mimic.arms.embodiment import Embodiment
from mimic.arms.pose_limits import continuous_joints, pose_limits
from mimic.base.compilation import compiled_once
from mimic.base.config import check_choice
from mimic.base.spatial import array_library
from mimic.metric.distance import Correspondence, Metric, Reduction, RotationMeasure, Weights
from mimic.metric.kinematics import resting_link_states
from mimic.retargeting.costs import Costs, with_costs
from mimic.retargeting.initial_guesses import RandomPoses, initial_guesses, random_poses, typical_distance
from mimic.retargeting.multistart import Descents, Method, best_descent
from mimic.retargeting.pose_objective import pose_objective

METHODS = ("newton", "gradient_descent")
AnyArray = TypeVar("AnyArray", Array, np.ndarray)

ITERATIONS = {"newton": 16, "gradient_descent": 1000}
_NO_COSTS = Costs()
FLAT = 1e-3  # gradient [1/rad] of a converged pose, as a fraction of the mean distance of random poses


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
    costs: Costs | None = None,
    capsules: Capsules | None = None,
) -> PoseImitation:
    """Learner pose of minimum embodiment distance to an expert pose, argmin d(s(q), s_hat(q_hat)) (paper, eq. 22).

    The distance has local minima, so each pose is optimised from several initial guesses: the expert's angles in the
    joints that both arms have by name, and the nearest pose of each of `starts` sets of random poses. The best result
    is returned. "newton" is a damped Newton method on the exact second derivative with negative curvature flipped
    (saddle-free Newton); "gradient_descent" is the paper's descent with a constant step.

    The first call compiles; later calls with equal arms, metric, options and shapes do not, see
    `mimic.base.compilation.by_value`. Functions in the metric are compared by identity: make a `lambda` once.

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
        the computation; on a GPU it halves the compilation.
      rotation: see `embodiment_distance`.
      reduction: see `embodiment_distance`.
      costs: see `Costs`; None for the embodiment distance alone. The returned distance is without them.
      capsules: of the learner, from `fit_capsules`, for the costs of collisions.

    Raises:
      ValueError: poses of the wrong shape or not finite, an unknown method, or a count below its minimum.
    """
    poses = checked_poses(expert, _concrete(qpos))
    check_choice("method", method, METHODS)
    # Longer than 40 lines: argument checks, and functions that share the arguments.
    count = ITERATIONS[method] if iterations is None else iterations
    if starts < 0 or count < 2:
        raise ValueError(f"starts, iterations: expected at least 0 and 2, got {starts} and {count}")
    if kept is not None and kept < 1:
        raise ValueError(f"kept: expected at least 1, or None for all, got {kept}")
    costs = _NO_COSTS if costs is None else costs
    costs.check_capsules(capsules)
    if costs.of_motion:
        raise ValueError(
            "costs: expected velocity and acceleration of 0 for single poses; imitate_trajectory takes them"
        )
    warm = None if warm_start is None else checked_poses(learner, _concrete(warm_start), "warm_start")
    metric = Metric(correspondence, weights, rotation, reduction)
    descents = Descents(method, count, kept)
    solve = _pose_solver(
        expert, learner, metric, descents, bool(starts), costs, capsules if costs.of_capsules else None
    )
    dtype = jax.dtypes.canonicalize_dtype(poses.dtype)
    return solve(poses, warm, random_poses(learner, key, max(starts, 1), dtype))


def _concrete(values: ArrayLike) -> Any:
    """The values as an array, without a copy to a device: functions of `jax.numpy` outside of `jax.jit` are slow."""
    return values if isinstance(values, jax.Array) else np.asarray(values)  # a tracer is a `jax.Array`


@compiled_once
def _pose_solver(
    expert: Embodiment,
    learner: Embodiment,
    metric: Metric,
    descents: Descents,
    random: bool,
    costs: Costs,
    capsules: Capsules | None,
) -> Callable[[Array, Array | None, RandomPoses], PoseImitation]:
    """The function of poses [..., n], warm starts [..., n_hat] and random poses that `imitate_pose` compiles."""
    objective = with_costs(pose_objective(learner, metric), costs, expert, learner, capsules)

    def solve(batch: Array, warm: Array | None, candidates: RandomPoses) -> PoseImitation:
        poses = jnp.asarray(batch).reshape(-1, expert.num_joints)
        states = resting_link_states(expert, poses.T)
        targets = jax.vmap(objective.target, (-1, 0), -1)(states, poses)
        if warm is None:
            first = shared_joints(expert, learner, poses)
            guess = functools.partial(initial_guesses, objective, candidates=candidates if random else None)
            guesses = jax.vmap(guess, (-1, 0), -1)(targets, first)
        else:
            warm = jnp.asarray(warm).reshape(-1, learner.num_joints)
            guesses = jnp.broadcast_to(warm, (len(poses), learner.num_joints)).T[None]
        solution = best_descent(objective.of_batch(targets), guesses, pose_limits(learner, poses.dtype), descents)
        distance = jax.vmap(objective.distance, -1)(states, resting_link_states(learner, solution.qpos))
        scale = typical_distance(objective, jax.tree.map(lambda x: x[..., 0], targets), candidates)
        qpos = wrap_angles(solution.qpos.T, continuous_joints(learner))
        solutions = PoseImitation(qpos, distance, solution.gradient_norm <= FLAT * scale)
        return jax.tree.map(lambda x: x.reshape(*batch.shape[:-1], *x.shape[1:]), solutions)

    return solve


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
