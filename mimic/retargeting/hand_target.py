"""The learner's hand where the expert's is, in metres: its target, its error, and the derivatives of a cost of both.

The cost of a hand is k^2 |p - p^|^2 / 2 + r (1 - cos theta), with p in chain lengths and theta the angle between target
and hand. Its derivatives are exact.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from mimic.arms.chain_match import matched_chains
from mimic.arms.embodiment import Embodiment, in_chain_lengths
from mimic.base import spatial
from mimic.base.batches import floats
from mimic.base.spatial import Rotation, Scalar, Vector
from mimic.metric.kinematics import JointFrame, LinkStates, hand_vectors, joint_axes, joint_frames
from mimic.retargeting.optimizers import Derivatives, Scalars

POSITION_TOLERANCE = 1e-4  # m
ROTATION_TOLERANCE = float(np.deg2rad(0.01))  # rad
_POSITION_STIFFNESS = 4.0  # k^2


class Placement(NamedTuple):
    """The pose of the learner's base in the expert's base frame, one for all poses or one for each.

    Attributes:
      rotation: [3, 3, *poses].
      position: [3, *poses] [m].
    """

    rotation: Float[Any, "3 3 *poses"]
    position: Float[Any, "3 *poses"]


class HandError(NamedTuple):
    """The error of hands, of several the maximum.

    Attributes:
      position: [*batch] distance between the hands [m].
      rotation: [*batch] angle between the hands [rad].
      exact: [*batch] whether both are within 0.1 mm and 0.01 deg, at joint angles within their ranges.
    """

    position: Float[Array, "*batch"]
    rotation: Float[Array, "*batch"]
    exact: Bool[Array, "*batch"]


class HandTarget(NamedTuple):
    """Hands of the expert in the learner's base frame.

    Attributes:
      position: [hands, 3, *batch] [m].
      axes: [hands, 3, 3, *batch] their x-, y- and z-axes, one a row.
    """

    position: Array
    axes: Array


def placement(base: Any) -> Placement:
    """The placement of the learner's base.

    Args:
      base: [x, y, z, yaw] in the expert's base frame [m, rad], a homogeneous matrix [4, 4], None for the same base, or
        a `Placement`.

    Raises:
      ValueError: another shape, a number that is not finite, a yaw beyond 2 pi, or a matrix that is no pose.
    """
    if isinstance(base, Placement):
        return base
    values = np.zeros(4) if base is None else np.asarray(floats(base, "base"), float)
    if values.shape not in ((4,), (4, 4)) or not np.all(np.isfinite(values)):
        raise ValueError(f"base: expected [x, y, z, yaw] or a pose [4, 4], all finite, got {values.tolist()}")
    if values.shape == (4,):
        if abs(values[3]) > 2 * np.pi:
            raise ValueError(f"base: expected a yaw of at most 2 pi rad, got {values[3]:g}")
        cosine, sine = np.cos(values[3]), np.sin(values[3])
        return Placement(np.array([[cosine, -sine, 0], [sine, cosine, 0], [0, 0, 1.0]]), values[:3])
    rotation = values[:3, :3]
    is_rotation = np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-6) and np.linalg.det(rotation) > 0
    if not is_rotation or not np.allclose(values[3], [0, 0, 0, 1]):
        raise ValueError(f"base: expected a rotation and a last row of 0 0 0 1, got {values.tolist()}")
    return Placement(rotation, values[:3, 3])


def matched_hands(expert: Embodiment, learner: Embodiment) -> np.ndarray:
    """Pairs [pairs, 2] of hands of expert and learner."""
    return np.array(matched_chains(expert.chain_names, learner.chain_names)).reshape(-1, 2)


def hand_components(arm: Embodiment, frames: list[JointFrame]) -> list[tuple[Vector, Rotation]]:
    """Position and axes (rows) of each hand, in the units of the arm."""
    rows = hand_vectors(arm, frames)
    triples = zip(rows[::3], rows[1::3], rows[2::3], strict=True)
    return [(x.position, (x.direction, y.direction, z.direction)) for x, y, z in triples]


def hands(arm: Embodiment, qpos: Scalars, chosen: Any) -> HandTarget:
    """Some hands of an arm, in its base frame; each with the batch axes of the joint angles last."""
    vectors = hand_components(arm, joint_frames(arm, qpos, None))
    vectors = [vectors[hand] for hand in chosen]

    def stack(values: list[Any]) -> Array:
        return jnp.stack([x + jnp.zeros_like(qpos[0]) for x in values])

    lanes = jnp.shape(qpos[0])
    position = jnp.stack([stack(list(position)) for position, _ in vectors])
    axes = jnp.stack([stack([x for axis in axes for x in axis]) for _, axes in vectors])
    return HandTarget(position, axes.reshape(-1, 3, 3, *lanes))


def in_base(base: Placement, target: HandTarget) -> HandTarget:
    """Hands in the expert's base frame, in that of the learner."""
    rows = spatial.transpose(spatial.rotation(jnp.asarray(base.rotation, target.position.dtype)))
    origin = jnp.asarray(base.position, target.position.dtype)[None]
    shift = origin.reshape(*origin.shape, *[1] * (target.position.ndim - origin.ndim))
    return HandTarget(rotated(rows, target.position - shift, 1), rotated(rows, target.axes, 2))


def placed_hands(base: Placement, hands: Float[np.ndarray, "time hands 4 4"]) -> Float[np.ndarray, "time hands 4 4"]:
    """Hands in the expert's base frame, in that of the learner, by NumPy; the base is one for all times."""
    inverse = np.eye(4)
    inverse[:3, :3] = np.transpose(base.rotation)
    inverse[:3, 3] = -inverse[:3, :3] @ base.position
    return inverse @ hands


def rotated(rows: Rotation, vectors: Array, axis: int) -> Array:
    """Vectors along an axis of an array, rotated; elementwise, so that nothing is rounded to TF32."""
    components = [jnp.take(vectors, i, axis) for i in range(3)]
    return jnp.stack([sum(x * y for x, y in zip(row, components, strict=True)) for row in rows], axis)


def states_in_base(base: Placement, states: LinkStates) -> LinkStates:
    """The expert's link states [links, 3, *batch] in the axes of the learner's base, each relative to its own base."""
    rows = spatial.transpose(spatial.rotation(jnp.asarray(base.rotation, states.position.dtype)))
    return jax.tree.map(lambda x: rotated(rows, x, 1), states)


class _HandTerms(NamedTuple):
    """What the derivatives of the cost of one hand are made of.

    Attributes:
      value: of the cost.
      force, torque: its gradients with respect to a translation and a rotation of the hand.
      velocities: of the hand with each joint of its line.
      axes: of these joints.
      couplings: of which the second derivative is k^2 v_i . v_j + a_i . y_j for a joint j and its ancestor i.
    """

    value: Scalar
    force: Vector
    torque: Vector
    velocities: list[Vector]
    axes: list[Vector]
    couplings: list[Vector]


def hand_cost_derivatives(
    learner: Embodiment, chosen: Any, target: HandTarget, qpos: Scalars, rotation_weight: Scalar
) -> Derivatives:
    """Derivatives of the cost of the hands.

    Args:
      learner: the embodiment.
      chosen: the hands that have a target.
      target: their poses, whose batch axes broadcast with those of the joint angles.
      qpos: joint angles [rad].
      rotation_weight: r.
    """
    arm, unit, joints = in_chain_lengths(learner), 1 / spatial.scalar(learner.chain_length), learner.num_joints
    lines = [joint_line(arm, arm.hand_joint[hand]) for hand in chosen]
    frames = joint_frames(arm, qpos, None)
    axes, anchors, vectors = (
        joint_axes(arm, frames),
        [frame.anchor for frame in frames[1:]],
        hand_components(arm, frames),
    )
    value: Any = 0.0
    gradient: list[Any] = [0.0] * joints
    hessian: list[list[Any]] = [[0.0] * (j + 1) for j in range(joints)]
    for number, (hand, line) in enumerate(zip(chosen, lines, strict=True)):
        goal = spatial.scale(unit, spatial.vector(target.position[number])), spatial.rotation(target.axes[number])
        of_line = [axes[joint] for joint in line], [anchors[joint] for joint in line]
        of_hand = _hand_terms(*of_line, vectors[hand], goal, rotation_weight)
        value = spatial.plus(value, of_hand.value)
        for place, j in enumerate(line):
            velocity, axis = of_hand.velocities[place], of_hand.axes[place]
            slope = spatial.plus(spatial.dot(of_hand.force, velocity), spatial.dot(of_hand.torque, axis))
            gradient[j] = spatial.plus(gradient[j], slope)
            stiff = spatial.scale(_POSITION_STIFFNESS, velocity)
            for other, i in enumerate(line[: place + 1]):
                entry = spatial.dot(of_hand.velocities[other], stiff)
                entry = spatial.plus(entry, spatial.dot(of_hand.axes[other], of_hand.couplings[place]))
                hessian[j][i] = spatial.plus(hessian[j][i], entry)
    return Derivatives(value, tuple(gradient), hessian)


def _hand_terms(
    axes: list[Vector], anchors: list[Vector], hand: tuple[Vector, Rotation], goal: tuple[Vector, Rotation], weight: Any
) -> _HandTerms:
    """With the hand's axes e, their targets t, and M = sum of e t^T: y_j = v_j x f + r/2 (tr(M) - M) a_j."""
    position, directions = hand
    difference = spatial.subtract(position, goal[0])
    matrix: Rotation = spatial.ZERO, spatial.ZERO, spatial.ZERO
    value, torque = 0.5 * _POSITION_STIFFNESS * spatial.dot(difference, difference), spatial.ZERO
    for direction, unit in zip(directions, goal[1], strict=True):
        apart = spatial.subtract(direction, unit)
        value = spatial.plus(value, 0.25 * weight * spatial.dot(apart, apart))
        torque = spatial.add(torque, spatial.cross(unit, direction))
        matrix = spatial.add_outer(matrix, direction, unit)
    force, half = spatial.scale(_POSITION_STIFFNESS, difference), 0.5 * weight
    trace = spatial.plus(spatial.plus(matrix[0][0], matrix[1][1]), matrix[2][2])
    velocities = [
        spatial.cross(axis, spatial.subtract(position, anchor)) for axis, anchor in zip(axes, anchors, strict=True)
    ]
    couplings = [
        spatial.add(
            spatial.cross(velocity, force),
            spatial.scale(half, spatial.subtract(spatial.scale(trace, axis), spatial.rotate(matrix, axis))),
        )
        for velocity, axis in zip(velocities, axes, strict=True)
    ]
    return _HandTerms(value, force, spatial.scale(half, torque), velocities, axes, couplings)


def joint_line(arm: Embodiment, joint: int) -> list[int]:
    """A joint and its ancestors, from the base on."""
    line = []
    while joint >= 0:
        line.append(joint)
        joint = arm.joint_parent[joint]
    return line[::-1]


def hand_error(target: HandTarget, hand: HandTarget) -> tuple[Array, Array]:
    """Maximum distance [m] and angle [rad] of hands, [*batch] each."""
    difference = hand.position - target.position
    distance = jnp.sqrt(jnp.sum(difference * difference, axis=1))
    apart = hand.axes - target.axes
    chord = jnp.sum(apart * apart, axis=(1, 2)) / 8  # sin^2 of half the angle
    angle = 2 * jnp.arcsin(jnp.sqrt(jnp.clip(chord, 0, 1)))
    return distance.max(axis=0), angle.max(axis=0)


def is_exact(distance: Any, angle: Any) -> Any:
    """Whether hands are within the tolerances; by NumPy for NumPy's arrays."""
    return (distance <= POSITION_TOLERANCE) & (angle <= ROTATION_TOLERANCE)
