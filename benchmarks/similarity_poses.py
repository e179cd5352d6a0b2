"""Poses of minimum distance for any pair of arms and any static correspondence, by one compiled function.

`imitate_pose` compiles anew for each pair of arms. Here arms are data, padded to the same number of joints and links,
so that a study of many pairs compiles once. Starts, iterations and Newton's method are those of `imitate_pose`.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from mimic.arms.embodiment import Embodiment
from mimic.metric.kinematics import LinkStates
from mimic.retargeting.optimizers import Derivatives, Scalars, Solution, newton
from mimic.retargeting.pose import pose_limits

JOINTS = LINKS = 7  # that arms are padded to
STARTS, RANDOM_POSES = 8, 264  # twelve starts lower the mean distance by less than 0.03 %
ROUGH, MORE, KEPT = 5, 11, 2  # Newton steps from every start, then more from the best two
_SMOOTH = 1e-3  # chain lengths; sqrt(r^2 + this^2) has a second derivative where r is 0


class ArmData(NamedTuple):
    """An embodiment as arrays of fixed shape, in chain lengths; see `Embodiment`.

    Attributes:
      axis, anchor: [JOINTS, 3].
      position, direction: [LINKS, 3] of the link frames in the zero pose.
      mover: [LINKS] the last joint that moves a link, counted from 1; 0 for none.
      lower, upper: [JOINTS] limits [rad], infinite for a full turn, 0 for a joint that is locked or padding.
      low, high: [JOINTS] range of random poses [rad].
    """

    axis: Any
    anchor: Any
    position: Any
    direction: Any
    mover: Any
    lower: Any
    upper: Any
    low: Any
    high: Any


def arm_data(arm: Embodiment, held: tuple[int, ...] = ()) -> ArmData:
    """An embodiment as data.

    Args:
      arm: of at most `JOINTS` joints and `LINKS` links.
      held: joints whose range becomes 0, counted from 0.

    Raises:
      ValueError: too many joints or links.
    """
    if arm.num_joints > JOINTS or arm.num_links > LINKS:
        raise ValueError(
            f"{arm.name}: expected at most {JOINTS} joints and {LINKS} links, got {arm.num_joints} and {arm.num_links}"
        )
    unit = 1 / float(arm.chain_length)
    free = ~np.isin(np.arange(arm.num_joints), held)
    ranges = [*pose_limits(arm, float), *np.asarray(arm.joint_range).T]
    return ArmData(
        _padded(arm.joint_axis, JOINTS),
        _padded(unit * np.asarray(arm.joint_anchor), JOINTS),
        _padded(unit * np.asarray(arm.link_position), LINKS),
        _padded(np.asarray(arm.link_rotation)[:, :, 0], LINKS),
        np.pad(np.asarray(arm.link_joint) + 1, (0, LINKS - arm.num_links)),
        *(_padded(np.where(free, values, 0), JOINTS) for values in ranges),
    )


def best_poses(arm: ArmData, states: LinkStates, matrix: Any, translation: float, own: Any) -> np.ndarray:
    """The learner's poses of minimum distance, for rotation weight 1 and the mean reduction.

    Args:
      arm: the learner.
      states: [poses, links, 3] of the expert, by `link_state_table`.
      matrix: [links, learner links] correspondence.
      translation: weight of the positions.
      own: [poses, learner joints] a start for each pose.

    Returns:
      [poses, JOINTS] [rad].
    """
    links = LINKS - states.position.shape[1]
    pads = ((0, 0), (0, links), (0, 0))
    weights = np.pad(np.asarray(matrix), ((0, links), (0, LINKS - np.shape(matrix)[1]))).astype(np.float32)
    start = np.pad(own, ((0, 0), (0, JOINTS - own.shape[1]))).astype(np.float32)
    start = np.clip(start, arm.lower, arm.upper)
    shape = STARTS, RANDOM_POSES // STARTS, JOINTS
    random = np.random.default_rng(1).uniform(arm.low, arm.high, shape).astype(np.float32)
    expert = np.pad(states.position, pads), np.pad(np.asarray(states.direction), pads)
    return np.asarray(_solve(arm, *expert, weights, np.float32(translation), start, random))


@jax.jit
def _solve(
    arm: ArmData, positions: Any, directions: Any, matrix: Any, translation: Any, own: Any, random: Any
) -> jax.Array:
    def one(position: Any, direction: Any, own: Any) -> jax.Array:
        def objective(qpos: Scalars) -> Derivatives:
            return _derivatives(arm, position, direction, matrix, translation, jnp.stack(qpos))

        def descend(start: Any, steps: int) -> Solution:
            return newton(objective, start, (arm.lower, arm.upper), steps)

        def value(qpos: Any) -> Any:
            return objective(tuple(qpos)).value

        tried = jax.vmap(jax.vmap(value))(random)
        nearest = jnp.take_along_axis(random, jnp.argmin(tried, axis=1)[:, None, None], axis=1)[:, 0]
        ends = jax.vmap(lambda start: descend(start, ROUGH))(jnp.concatenate([own[None], nearest]))
        best = jax.lax.top_k(-ends.value, KEPT)[1]
        ends = jax.vmap(lambda start: descend(start, MORE))(ends.qpos[best])
        return ends.qpos[jnp.argmin(ends.value)]

    return jax.vmap(one)(positions, directions, own)


def _derivatives(
    arm: ArmData, position: Any, direction: Any, matrix: Any, translation: Any, qpos: jax.Array
) -> Derivatives:
    """Of sum_ij W_ij (a |p_i - p^_j| + (pi/2) (1 - e_i . e^_j)), with two derivatives in closed form.

    Joint k, with axis a_k through c_k, moves a link's position by J_k = a_k x (p - c_k) and its direction by a_k x e;
    for k <= m, both second derivatives are a_k x J_m.
    """
    axes, anchors, points, ways = _forward(arm, qpos)
    moves = (arm.mover[:, None] > jnp.arange(JOINTS)).astype(qpos.dtype)[:, :, None]  # [links, joints, 1]
    by_point = moves * jnp.cross(axes[None], points[:, None] - anchors[None])
    by_way = moves * jnp.cross(axes[None], ways[:, None])
    apart = points[None] - position[:, None]  # [expert, learner, 3]
    distance = jnp.sqrt(jnp.sum(apart**2, axis=-1) + _SMOOTH**2)
    turned = jnp.sum((ways[None] - direction[:, None]) ** 2, axis=-1)
    value = jnp.sum(matrix * (translation * distance + 0.25 * jnp.pi * turned))
    share = translation * matrix / distance
    point_gradient = jnp.sum(share[..., None] * apart, axis=0)  # [learner, 3]
    way_gradient = -0.5 * jnp.pi * jnp.sum(matrix[..., None] * direction[:, None], axis=0)
    gradient = jnp.sum(by_point * point_gradient[:, None] + by_way * way_gradient[:, None], axis=(0, 2))
    bend = jnp.cross(by_point, point_gradient[:, None]) + jnp.cross(by_way, way_gradient[:, None])
    bend = jnp.sum(bend, axis=0)  # [joints, 3]
    unit = apart / distance[..., None]
    curvature = jnp.sum(share, axis=0)[:, None, None] * jnp.eye(3) - jnp.sum(
        share[..., None, None] * unit[..., :, None] * unit[..., None, :], axis=0
    )  # [learner, 3, 3]
    bent = jnp.sum(curvature[:, None] * by_point[:, :, None, :], axis=-1)  # [learner, joints, 3]
    rows = []
    for m in range(JOINTS):
        row = jnp.sum(by_point[:, : m + 1] * bent[:, m, None], axis=(0, 2)) + jnp.sum(axes[: m + 1] * bend[m], axis=-1)
        rows.append(tuple(row[k] for k in range(m + 1)))
    return Derivatives(value, tuple(gradient[k] for k in range(JOINTS)), tuple(rows))


def _forward(arm: ArmData, qpos: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array, jax.Array]:
    """Axes and anchors of the joints, positions and directions of the links, each [n, 3] in the base frame."""
    rotation, point = jnp.eye(3, dtype=qpos.dtype), jnp.zeros(3, qpos.dtype)
    before = jnp.zeros(3, qpos.dtype)
    rotations, points, axes = [rotation], [point], []
    for k in range(JOINTS):
        axis, anchor = jnp.asarray(arm.axis[k], qpos.dtype), jnp.asarray(arm.anchor[k], qpos.dtype)
        axes.append(_apply(rotation, axis))
        point = point + _apply(rotation, anchor - before)
        sine, cosine = jnp.sin(qpos[k]), jnp.cos(qpos[k])
        columns = [  # of the rotation after the joint: R times Rodrigues' formula
            _apply(rotation, cosine * unit + sine * jnp.cross(axis, unit) + (1 - cosine) * axis[i] * axis)
            for i, unit in enumerate(jnp.eye(3, dtype=qpos.dtype))
        ]
        rotation, before = jnp.stack(columns, axis=1), anchor
        rotations.append(rotation)
        points.append(point)
    turn, origin = jnp.stack(rotations)[arm.mover], jnp.stack(points)[arm.mover]
    zero = jnp.concatenate([jnp.zeros((1, 3), qpos.dtype), jnp.asarray(arm.anchor, qpos.dtype)])[arm.mover]
    place = origin + jnp.sum(turn * (jnp.asarray(arm.position, qpos.dtype) - zero)[:, None], axis=-1)
    ways = jnp.sum(turn * jnp.asarray(arm.direction, qpos.dtype)[:, None], axis=-1)
    return jnp.stack(axes), jnp.stack(points[1:]), place, ways


def _apply(rotation: jax.Array, vector: jax.Array) -> jax.Array:
    return jnp.sum(rotation * vector, axis=-1)


def _padded(values: Any, count: int) -> np.ndarray:
    values = np.asarray(values, np.float32)
    return np.pad(values, ((0, count - len(values)),) + ((0, 0),) * (values.ndim - 1))
