"""Static pose imitation (pose retargeting): the learner's pose nearest to a pose of the expert."""

import functools
from collections.abc import Callable, Sequence
from typing import Any, Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jax.typing import ArrayLike
from jaxtyping import Array, Bool, Float

from mimic.arms.arrays import ArmArrays
from mimic.arms.capsules import Capsules
from mimic.arms.embodiment import Embodiment
from mimic.arms.pose_limits import continuous_joints, pose_limits
from mimic.base.batches import floats
from mimic.base.compilation import compiled_once
from mimic.base.config import check_choice
from mimic.base.spatial import array_library
from mimic.metric.distance import Correspondence, DistanceWeights, Metric, Reduction, RotationMeasure, Weights
from mimic.metric.hand import NO_HAND, HandWeights
from mimic.metric.kinematics import resting_link_states
from mimic.retargeting.costs import NO_COSTS, Costs, with_costs
from mimic.retargeting.exact_pose import SET, exact_poses, exact_solver
from mimic.retargeting.hand_target import HandError, Placement, placement
from mimic.retargeting.initial_guesses import RandomPoses, initial_guesses, random_poses, typical_distance
from mimic.retargeting.multistart import Descents, best_descent
from mimic.retargeting.pose_objective import PoseObjective, pose_objective

Hand = Literal["free", "exact"]
HANDS = ("free", "exact")

ITERATIONS = 16
STARTS = {"free": 12, "exact": 35}
_LARGEST_ANGLE = 1e4  # rad; float32 resolves 0.001 rad there, and less beyond
FLAT = 1e-3  # gradient [1/rad] of a converged pose, as a fraction of the mean distance of random poses


class PoseImitation(NamedTuple):
    """Nearest poses of the learner.

    Attributes:
      qpos: [*batch, learner_joints] angles [rad].
      distance: [*batch] embodiment distance at these poses.
      converged: [*batch] whether the gradient vanishes, apart from joints at a limit. Matching positions are a kink of
        the distance; there it is the gradient of the smoothed distance (see `mimic.retargeting.closed_form`). With
        exact hands, whether the hand is exact.
      hand: its error, with exact hands.
    """

    qpos: Float[Array, "*batch learner_joints"]
    distance: Float[Array, "*batch"]
    converged: Bool[Array, "*batch"]
    hand: HandError | None = None


def imitate_pose(
    expert: Embodiment | ArmArrays,
    learner: Embodiment | ArmArrays,
    qpos: Float[ArrayLike, "*batch expert_joints"],
    correspondence: Correspondence,
    weights: Weights,
    *,
    hand: Hand = "free",
    base: Any = None,
    starts: int | None = None,
    key: Array | None = None,
    warm_start: Float[ArrayLike, "*batch learner_joints"] | None = None,
    iterations: int = ITERATIONS,
    kept: int | None = 2,
    rotation: RotationMeasure = "cosine",
    reduction: Reduction = "mean",
    hand_weights: HandWeights = NO_HAND,
    costs: Costs | None = None,
    capsules: Capsules | None = None,
) -> PoseImitation:
    """Learner pose of minimum embodiment distance to an expert pose, argmin d(s(q), s_hat(q_hat)) (paper, eq. 22).

    The distance has local minima, so each pose is optimised from several initial guesses: the expert's angles in the
    joints that both arms have by name, and the nearest pose of each of `starts` sets of random poses. The best result
    is returned. The method is Newton's, damped, on the exact second derivative with negative curvature flipped
    (saddle-free Newton).

    The first call compiles; later calls with equal arms, metric, options and shapes do not, see
    `mimic.base.compilation.by_value`. Functions in the metric are compared by identity: make a `lambda` once.

    Arms as data (`ArmArrays`) with as many slots share one compiled function, whatever their numbers, weights and
    locked joints. It is made for single poses: a batch takes 13 times as long as with embodiments, which are
    constants. The metric must be a weighted sum, see `Metric.is_weighted_sum`, and there are no costs.

    Args:
      expert: n joints.
      learner: n_hat joints, optimised within their ranges; joints with a range of a full revolution end in [-pi, pi].
        An arm as data if the expert is one; of the two, joints with the same index are those that both have.
      qpos: [n] or [..., n] the expert's poses [rad].
      correspondence: see `embodiment_distance`.
      weights: see `embodiment_distance`; velocities are zero.
      hand: "exact" puts the learner's hand where the expert's is, in metres, and takes of all postures with this hand
        within the joint ranges the one of minimum distance. Where none is found, as with fewer than six joints or out
        of reach, the hand's position is the nearest, and then its rotation: see `PoseImitation.hand`. Costs count among
        postures with this hand; `iterations` and `kept` are of "free", which leaves the hand to the metric.
      base: the learner's base in the expert's base frame, for exact hands: x, y, z, yaw in m and rad, or a pose [4, 4];
        None for the same base. Link directions are compared in the same axes, positions each from its own base.
      starts: number of random initial guesses, 12 where None, 35 for exact hands; with 0 the expert's angles are the
        only one.
      key: of the random poses; `jax.random.key(0)` where None.
      warm_start: [..., n_hat] replaces all initial guesses.
      iterations: of each descent.
      kept: number of best descents that continue after a third of the iterations. None continues all, which doubles
        the computation; on a GPU it halves the compilation.
      rotation: see `embodiment_distance`.
      reduction: see `embodiment_distance`.
      hand_weights: see `embodiment_distance`.
      costs: see `Costs`; None for the embodiment distance alone. The returned distance is without them.
      capsules: of the learner, from `fit_capsules`, for the costs of collisions.

    Raises:
      ValueError: poses of the wrong shape, not finite or above 10,000 rad, or a count below its minimum.
    """
    poses = checked_poses(expert, qpos)
    # Longer than 40 lines: argument checks, and functions that share the arguments.
    check_hand(hand, base, expert, learner)
    starts = STARTS[hand] if starts is None else starts
    check_count("starts", starts, 0)
    check_count("iterations", iterations, 2)
    if kept is not None:
        check_count("kept", kept, 1)
    costs = NO_COSTS if costs is None else costs
    costs.check_capsules(capsules)
    if costs.of_motion:
        raise ValueError(
            "costs: expected velocity and acceleration of 0 for single poses; imitate_trajectory takes them"
        )
    warm = None if warm_start is None else checked_poses(learner, warm_start, "warm_start")
    metric = Metric(correspondence, weights, rotation, reduction, hand_weights)
    descents = Descents(iterations, kept)
    dtype = jax.dtypes.canonicalize_dtype(poses.dtype)
    if hand == "exact":
        solve = _exact_solver(expert, learner, metric, bool(starts), costs, capsules if costs.of_capsules else None)
        return solve(poses, placement(base), warm, random_poses(learner, key, max(starts, 1), dtype, SET))
    candidates = random_poses(learner, key, max(starts, 1), dtype)
    if isinstance(expert, ArmArrays) or isinstance(learner, ArmArrays):
        data = _data_of(expert, learner, metric, costs, dtype)
        in_parallel = descents._replace(kept=None if kept is None else starts + 1)
        return _data_solver(in_parallel, bool(starts), rotation)(data, poses, warm, candidates)
    solve = _pose_solver(
        expert, learner, metric, descents, bool(starts), costs, capsules if costs.of_capsules else None
    )
    return solve(poses, warm, candidates)


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
        return _nearest(expert, learner, objective, descents, batch, warm, candidates, random)

    return solve


def check_count(name: str, value: Any, at_least: int) -> None:
    """Raises a `ValueError` for what is no whole number of at least the minimum."""
    if not isinstance(value, int | np.integer) or value < at_least:
        raise ValueError(f"{name}: expected a whole number of at least {at_least}, got {value!r}")


def check_hand(hand: Hand, base: Any, expert: Embodiment | ArmArrays, learner: Embodiment | ArmArrays) -> None:
    """Raises a `ValueError` for an unknown `hand`, arms as data with exact hands, or a base without these."""
    check_choice("hand", hand, HANDS)
    if hand == "free" and base is not None:
        raise ValueError('base: expected None for hand="free", which compares each arm from its own base')
    if hand == "exact" and (isinstance(expert, ArmArrays) or isinstance(learner, ArmArrays)):
        raise ValueError('hand: expected embodiments for "exact", got an arm as data')
    for name, arm in (("expert", expert), ("learner", learner)):
        if hand == "exact" and not arm.hand_joint:  # type: ignore[union-attr]
            raise ValueError(f'hand: expected arms with a hand for "exact", got none of the {name}, {arm.name}')


@compiled_once
def _exact_solver(
    expert: Embodiment,
    learner: Embodiment,
    metric: Metric,
    random: bool,
    costs: Costs,
    capsules: Capsules | None,
) -> Callable[[Array, Placement, Array | None, RandomPoses], PoseImitation]:
    """As `_pose_solver`, for exact hands; it also takes the learner's base."""
    solver = exact_solver(expert, learner, metric, costs, capsules)

    def solve(batch: Array, base: Placement, warm: Array | None, candidates: RandomPoses) -> PoseImitation:
        poses = jnp.asarray(batch).reshape(-1, expert.num_joints)
        guess = shared_joints(expert, learner, poses)
        if warm is not None:
            guess = jnp.broadcast_to(jnp.asarray(warm).reshape(-1, learner.num_joints), guess.shape)
        qpos, distance, error = exact_poses(solver, base, poses, guess, candidates if random and warm is None else None)
        qpos = wrap_angles(qpos, continuous_joints(learner))
        solutions = PoseImitation(qpos, distance, error.exact, error)
        return jax.tree.map(lambda x: x.reshape(*batch.shape[:-1], *x.shape[1:]), solutions)

    return solve


class _PoseData(NamedTuple):
    """What the compiled function of arms as data takes beside the poses.

    Attributes:
      expert, learner: the arms.
      matrix: correspondence of the links.
      weights: of the metric.
      hand_weights: of the metric; None where it has no hand.
      pairs: [pairs, 2] links of both; all whose correspondence is not 0, and some others up to a fixed number.
    """

    expert: ArmArrays
    learner: ArmArrays
    matrix: Any
    weights: DistanceWeights
    hand_weights: HandWeights | None
    pairs: Any


def _data_of(expert: Any, learner: Any, metric: Metric, costs: Costs, dtype: Any) -> _PoseData:
    """The data of two arms and their metric.

    Raises:
      ValueError: one arm that is no data, or a metric or costs that only embodiments have.
    """
    if not (isinstance(expert, ArmArrays) and isinstance(learner, ArmArrays)):
        raise ValueError("expert, learner: expected two embodiments or two arms as data, got one of each")
    if not metric.is_weighted_sum or costs != NO_COSTS:
        raise ValueError(
            "metric, costs: expected a constant correspondence and weights, the reduction mean and no costs for arms "
            "as data; embodiments take all"
        )
    shape = metric.correspondence.shape  # type: ignore[union-attr]
    if isinstance(metric.correspondence, Tracer):
        pairs = np.argwhere(np.ones(shape, bool))
    else:
        matrix = np.asarray(metric.correspondence)
        pairs, empty = np.argwhere(matrix != 0), np.argwhere(matrix == 0)
        count = sum(shape) if len(pairs) <= sum(shape) else matrix.size  # that of chains by arc length is below the sum
        pairs = np.concatenate([pairs, empty, empty[:1].repeat(sum(shape), axis=0)])[:count]
    hand_weights = None if metric.hand_weights.are_zero else metric.hand_weights  # None: traced numbers are never zero
    matrix, weights = jax.tree.map(lambda x: _concrete(x).astype(dtype), (metric.correspondence, metric.weights))
    return _PoseData(expert.astype(dtype), learner.astype(dtype), matrix, weights, hand_weights, pairs)


@compiled_once
def _data_solver(descents: Descents, random: bool, rotation: RotationMeasure) -> Callable[..., PoseImitation]:
    """The function of data, poses, warm starts and random poses that `imitate_pose` compiles for arms as data."""

    def solve(data: _PoseData, batch: Array, warm: Array | None, candidates: RandomPoses) -> PoseImitation:
        objective = pose_objective(
            data.learner,
            Metric(data.matrix, data.weights, rotation, hand_weights=data.hand_weights or NO_HAND),
            data.pairs,
        )
        return _nearest(data.expert, data.learner, objective, descents, batch, warm, candidates, random)

    return solve


def _nearest(
    expert: Embodiment | ArmArrays,
    learner: Embodiment | ArmArrays,
    objective: PoseObjective,
    descents: Descents,
    batch: Array,
    warm: Array | None,
    candidates: RandomPoses,
    random: bool,
) -> PoseImitation:
    """The nearest poses to a batch [..., n]."""
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
    expert: Embodiment | ArmArrays, learner: Embodiment | ArmArrays, values: Float[Any, "*batch expert_joints"]
) -> Float[Any, "*batch learner_joints"]:
    """The expert's values in the joints that both arms have by name; zero in the learner's other joints.

    Arms as data have joints by index; locked ones stay at home, and so do the learner's further ones.
    """
    if isinstance(expert, ArmArrays) or isinstance(learner, ArmArrays):
        common = min(values.shape[-1], learner.num_joints)
        home = jnp.broadcast_to(learner.home, (*values.shape[:-1], learner.num_joints)).astype(values.dtype)
        filled = home.at[..., :common].set(values[..., :common])
        return jnp.where(jnp.asarray(learner.is_free) > 0, filled, home)  # type: ignore[union-attr]
    names = expert.joint_names
    index = np.array([names.index(name) if name in names else -1 for name in learner.joint_names])
    return array_library(values).where(index >= 0, values[..., index], 0)


def checked_poses(
    arm: Embodiment | ArmArrays, poses: ArrayLike, name: str = "qpos", *, axes: Sequence[str] = ()
) -> Any:
    """The poses as floating-point numbers, a JAX array where they are one and else a NumPy array.

    Args:
      arm: the embodiment.
      poses: joint angles [rad].
      name: of the argument, for the error.
      axes: names of the required axes before that of the joints.

    Raises:
      ValueError: the shape is not [..., *axes, joints], there is no pose, or an angle is no number up to 10,000 rad.
    """
    array: Any = floats(poses, name)
    if array.ndim <= len(axes) or array.shape[-1] != arm.num_joints:
        shape = ", ".join(["...", *axes, str(arm.num_joints)])
        raise ValueError(f"{name}: expected shape [{shape}] for {arm.name}, got {array.shape}")
    if not array.size:
        raise ValueError(f"{name}: expected one pose or more, got shape {array.shape}")
    if not isinstance(array, Tracer) and not np.all(np.abs(values := np.asarray(array)) <= _LARGEST_ANGLE):
        worst = values[~(np.abs(values) <= _LARGEST_ANGLE)][0]
        raise ValueError(f"{name}: expected finite angles of at most {_LARGEST_ANGLE:,g} rad, got {worst:g}")
    return array
