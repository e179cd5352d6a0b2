"""The embodiment distance as a function of the learner's pose, with its first two derivatives."""

import dataclasses
import functools
from collections.abc import Callable
from typing import Any, NamedTuple, cast

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Bool, Int

from mimic.arms.arrays import ArmArrays
from mimic.arms.embodiment import Embodiment, in_chain_lengths
from mimic.base import spatial
from mimic.base.compat import stored
from mimic.base.spatial import Rotation, Vector, array_library
from mimic.metric.distance import PARTS, DistanceWeights, Metric, RotationMeasure
from mimic.metric.kinematics import (
    LinkStates,
    hand_vectors,
    joint_axes,
    joint_frames,
    link_states,
    link_vectors,
    row_joints,
)
from mimic.retargeting.closed_form import (
    SMOOTHING,
    Body,
    Load,
    Pull,
    Smoothing,
    add_directions,
    add_position,
    derivatives_of_loads,
    distal_loads,
    smoothed_angle,
    smoothed_length,
    static_derivatives,
    total,
)
from mimic.retargeting.optimizers import Derivatives, Scalars

Target = Any  # pytree: the data of the expert's pose that the objective needs


@dataclasses.dataclass(frozen=True)
class PoseObjective:
    """The objective of pose imitation, as functions.

    Attributes:
      distance: (expert's link states, learner's link states) -> embodiment distance, both at rest.
      target: (expert's link states, expert's pose) -> target.
      value: (target, learner's link states) -> distance with smoothed lengths and angles.
      derivatives: (target, joint angles, smoothing) -> derivatives of the distance; the value up to a constant of the
        target. `smoothing`, a `mimic.retargeting.closed_form.Smoothing`, may be omitted.
      is_elementwise: whether `derivatives` also takes arrays of poses for each joint, which broadcast with arrays of
        targets; see `of_batch`.
    """

    distance: Callable[[LinkStates, LinkStates], Array]
    target: Callable[..., Target]
    value: Callable[[Target, LinkStates], Array]
    derivatives: Callable[..., Derivatives]
    is_elementwise: bool = False

    def of_batch(self, targets: Target) -> Callable[..., Derivatives]:
        """`derivatives` for joint angles [lanes, poses] each.

        Args:
          targets: one for each pose, along the last axis of each array.
        """
        if self.is_elementwise:
            return functools.partial(self.derivatives, targets)

        def derivatives(qpos: Scalars, smoothing: Smoothing = SMOOTHING) -> Derivatives:
            def at(target: Target, qpos: Scalars) -> Derivatives:
                return self.derivatives(target, qpos, smoothing)

            return jax.vmap(jax.vmap(at, (None, 0)), (-1, -1), -1)(targets, tuple(qpos))

        return derivatives


def pose_objective(
    learner: Embodiment | ArmArrays, metric: Metric, pairs: Int[Any, "pairs 2"] | None = None
) -> PoseObjective:
    """The objective: in closed form for a weighted sum, see `_static`; else by automatic differentiation.

    Args:
      learner: the embodiment, or an arm as data.
      metric: the metric.
      pairs: links of expert and learner whose weight is not 0, for a traced correspondence; may be traced and have
        more. All where None.
    """
    return _static(learner, metric, pairs) if metric.is_weighted_sum else _differentiated(learner, metric)


def _differentiated(learner: Embodiment | ArmArrays, metric: Metric) -> PoseObjective:
    def derivatives(target: LinkStates, qpos: Scalars, smoothing: Any = None) -> Derivatives:
        return automatic_derivatives(lambda q: metric(target, link_states(learner, q)), qpos)

    return PoseObjective(metric, lambda states, _=None: states, metric, derivatives)


def automatic_derivatives(function: Callable[[Array], Array], qpos: Scalars) -> Derivatives:
    """Derivatives of a function of joint angles, by automatic differentiation."""

    def gradient_and_value(qpos: Array) -> tuple[Array, tuple[Array, Array]]:
        value, gradient = jax.value_and_grad(function)(qpos)
        return gradient, (value, gradient)

    hessian, (value, gradient) = jax.jacfwd(gradient_and_value, has_aux=True)(jnp.stack(qpos))
    return Derivatives(value, tuple(gradient), tuple(map(tuple, hessian)))


class StaticTarget(NamedTuple):
    """Target of a weighted sum: pulls on the learner's directions and positions (`mimic.retargeting.closed_form`).

    Rows are links, and the axes of hands after them where the metric has hands, see `Metric.factors`.

    Attributes:
      units, strengths: [directions, 3], [directions] of the pulls on directions.
      points, weights: [pairs, 3], [pairs] of the pulls on positions.
    """

    units: Array
    strengths: Array
    points: Array
    weights: Array


def _static(
    learner: Embodiment | ArmArrays, metric: Metric, chosen: Int[Any, "pairs 2"] | None = None
) -> PoseObjective:
    """Constant W and weights, and the mean: sums of W_ij (pi/2) (1 - e_i . e^_j) or angles, and W_ij |p_i - p^_j|.

    For the cosines the expert reduces to one pull on each row of the learner, t_j = sum_i W_ij e_i.
    """
    correspondence, weights = cast(Any, metric.correspondence), cast(DistanceWeights, metric.weights)
    has_hand, shape = not metric.hand_weights.are_zero, np.shape(correspondence)
    expert_hands = 1 + max(i for i, _ in metric.hand_weights.pairs)
    factors = metric.factors(expert_hands, 1 if isinstance(learner, ArmArrays) else len(learner.hand_joint))
    positions, directions = (factors[PARTS.index(part)] for part in ("translation", "rotation"))
    pairs = _weighted_pairs(correspondence, weights.translation) if chosen is None else chosen
    if has_hand:
        hands = [[shape[0] + 3 * i, shape[1] + 3 * j] for i, j in metric.hand_weights.pairs]
        pairs = array_library(pairs).concatenate([pairs, np.array(hands)])
    angles = None
    if metric.rotation == "angle":
        angles = _weighted_pairs(correspondence, weights.rotation) if chosen is None else chosen
    directed = np.arange(directions.shape[1]) if angles is None else angles[:, 1]  # row of each direction's pull

    def rows(states: LinkStates) -> tuple[Array, Array]:
        assert states.direction is not None
        if not has_hand:
            return states.position, states.direction
        assert states.hand is not None
        position = jnp.concatenate([states.position, jnp.repeat(states.hand.position, 3, axis=0)])
        return position, jnp.concatenate([states.direction, states.hand.axes])

    def pulls_on_directions(direction: Array) -> tuple[Array, Array]:
        if angles is not None:
            return direction[angles[:, 0]], jnp.asarray(directions[angles[:, 0], angles[:, 1]], direction.dtype)
        # Elementwise, so that nothing is rounded to TF32.
        pull = np.pi / 2 * jnp.sum(directions[:, :, None] * direction[: len(directions), None, :], axis=0)
        strength = spatial.safe_sqrt(jnp.sum(pull * pull, axis=-1))
        unit = pull / jnp.maximum(strength, jnp.finfo(pull.dtype).tiny)[:, None]
        return unit.astype(direction.dtype), strength.astype(direction.dtype)

    def target(states: LinkStates, _: Any = None) -> StaticTarget:
        position, direction = rows(states)
        units, strengths = pulls_on_directions(direction)
        points = position[pairs[:, 0]]
        weights = jnp.asarray(positions[pairs[:, 0], pairs[:, 1]], points.dtype)
        return StaticTarget(units, strengths, points, weights)

    def value(target: StaticTarget, states: LinkStates) -> Array:
        position, direction = rows(states)
        direction = direction[directed]
        if angles is None:
            turned = np.pi / 2 * directions.sum() - jnp.sum(target.strengths[:, None] * target.units * direction)
        else:
            sine = jnp.cross(direction, target.units)
            cosine = jnp.sum(direction * target.units, axis=-1)
            angle = smoothed_angle(cosine, jnp.sum(sine * sine, axis=-1), SMOOTHING.angle)
            turned = jnp.sum(target.strengths * angle)
        difference = position[pairs[:, 1]] - target.points
        square = jnp.sum(difference * difference, axis=-1)
        return jnp.sum(target.weights * smoothed_length(square, SMOOTHING.length)) + turned

    make = _of_data if isinstance(learner, ArmArrays) else _of_constant
    derivatives = make(learner, pairs, directed, metric.rotation, has_hand)  # type: ignore[arg-type]
    return PoseObjective(metric, target, value, derivatives, is_elementwise=True)


def _of_constant(
    learner: Embodiment, pairs: np.ndarray, directed: np.ndarray, rotation: RotationMeasure, has_hand: bool
) -> Callable[..., Derivatives]:
    """The derivatives for an embodiment, with all rows and pairs unrolled."""
    arm = in_chain_lengths(learner)
    joints = row_joints(arm) if has_hand else arm.link_joint

    def kinematics(qpos: Scalars) -> tuple[list[Vector], list[Vector], list[tuple[Vector, Vector]]]:
        frames = joint_frames(arm, qpos, None)
        rows = link_vectors(arm, frames) + (hand_vectors(arm, frames) if has_hand else [])
        vectors = [(row.direction, row.position) for row in rows]
        return joint_axes(arm, frames), [frame.anchor for frame in frames[1:]], vectors

    def derivatives(target: StaticTarget, qpos: Scalars, smoothing: Smoothing = SMOOTHING) -> Derivatives:
        axes, anchors, vectors = stored(kinematics(qpos))
        rows = [Body(joint, *vector) for joint, vector in zip(joints, vectors, strict=True)]
        pulls = [_pull(target, directed == row, pairs[:, 1] == row) for row in range(len(rows))]
        return static_derivatives(axes, anchors, rows, pulls, arm.joint_parent, smoothing, rotation=rotation)

    return derivatives


def _of_data(
    learner: ArmArrays, pairs: Any, directed: Any, rotation: RotationMeasure, has_hand: bool
) -> Callable[..., Derivatives]:
    """The derivatives for an arm as data: links and pairs are rows of arrays, and the links' joints may be traced.

    On two cores a Panda's pose takes four times the time of that of a constant arm, and a batch 13 times; it compiles
    three times as long, once for all arms.
    """
    arm, joints = learner.in_chain_lengths(), learner.num_joints
    row_joint, row_position, row_direction = (
        arm.rows if has_hand else (arm.link_joint, arm.link_position, arm.link_direction)
    )

    def columns(vectors: Any) -> Vector:
        return vectors[:, 0, None, None], vectors[:, 1, None, None], vectors[:, 2, None, None]

    def of_rows(frames: Array, links: Any, vectors: Any) -> tuple[Rotation, Vector, Vector]:
        x = jnp.moveaxis(frames[jnp.asarray(row_joint)[links] + 1], 1, 0)
        return (tuple(x[:3]), tuple(x[3:6]), tuple(x[6:9])), tuple(x[9:12]), columns(jnp.asarray(vectors)[links])  # type: ignore[return-value]

    def derivatives(target: StaticTarget, qpos: Scalars, smoothing: Smoothing = SMOOTHING) -> Derivatives:
        lanes = jnp.broadcast_shapes(*(jnp.shape(q) for q in qpos), target.points.shape[2:])
        dtype = target.points.dtype

        def kinematics(qpos: Scalars) -> list[tuple[Rotation, Vector]]:
            return [(frame.rotation, frame.anchor) for frame in joint_frames(arm.astype(dtype), qpos, None)]

        frames = stored(kinematics(qpos))
        table = jnp.stack(
            [
                jnp.stack([jnp.broadcast_to(jnp.asarray(x, dtype), lanes) for x in jax.tree.leaves(frame)])
                for frame in frames
            ]
        )
        points, units = ((x[:, 0, None], x[:, 1, None], x[:, 2, None]) for x in (target.points, target.units))
        positions = Pull([], [], [points], [target.weights[:, None]])
        directions = Pull([units], [target.strengths[:, None]], [], [])

        def position_of_pairs(table: Array) -> Vector:
            rotation_of_link, anchor, offset = of_rows(table, pairs[:, 1], row_position)
            return spatial.add(anchor, spatial.rotate(rotation_of_link, offset))

        def direction_of_links(table: Array) -> Vector:
            rotation_of_link, _, direction = of_rows(table, directed, row_direction)
            return spatial.rotate(rotation_of_link, direction)

        of_pairs = add_position(Load(), stored(position_of_pairs(table)), positions, smoothing.length)
        of_links = add_directions(Load(), stored(direction_of_links(table)), directions, rotation, smoothing.angle)
        loads = [
            total(*both)
            for both in zip(
                distal_loads(of_pairs, jnp.asarray(row_joint)[pairs[:, 1]], joints),
                distal_loads(of_links, jnp.asarray(row_joint)[directed], joints),
                strict=True,
            )
        ]
        axes = [tuple(row[2] for row in frame[0]) for frame in frames[1:]]
        anchors = [frame[1] for frame in frames[1:]]
        return derivatives_of_loads(axes, anchors, loads, range(-1, joints - 1), loads[0].value)  # type: ignore[arg-type]

    return derivatives


def _weighted_pairs(correspondence: Any, weight: Any) -> Int[np.ndarray, "pairs 2"]:
    """Pairs of links with a weight on positions; all pairs where W is traced."""
    has_weight = np.full(np.shape(correspondence), True)
    if not isinstance(correspondence, Tracer):
        has_weight &= np.asarray(correspondence) != 0
    if not isinstance(weight, Tracer):
        has_weight &= np.asarray(weight) != 0
    return np.argwhere(has_weight)


def _pull(target: StaticTarget, directions: Bool[np.ndarray, " directions"], pairs: Bool[np.ndarray, " pairs"]) -> Pull:
    """Pull on one row as scalars, from those of the target's directions and pairs that are on it."""
    directions, pairs = np.flatnonzero(directions), np.flatnonzero(pairs)
    return Pull(
        [spatial.vector(target.units[i]) for i in directions],
        [target.strengths[i] for i in directions],
        [spatial.vector(target.points[i]) for i in pairs],
        [target.weights[i] for i in pairs],
    )
