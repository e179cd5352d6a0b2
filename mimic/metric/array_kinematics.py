"""Link states of any arm, the metric between two arms, and the joints' effect on the links."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Float

from mimic.arms.arrays import MAX_JOINTS, ArmArrays
from mimic.base import spatial
from mimic.metric.config import MetricConfig
from mimic.metric.correspondence import overlaps_of_chains
from mimic.metric.distance import DistanceWeights, Metric
from mimic.metric.kinematics import LinkStates


@struct.dataclass
class JointStates:
    """Frames of an arm's base and of its joints, [joints + 1, ...] in the base frame.

    Attributes:
      rotation: [joints + 1, 3, 3].
      origin: [joints + 1, 3] [m].
      angular_velocity: [joints + 1, 3] [rad/s].
      linear_velocity: [joints + 1, 3] of the origins [m/s].
    """

    rotation: Float[Array, "frames 3 3"]
    origin: Float[Array, "frames 3"]
    angular_velocity: Float[Array, "frames 3"]
    linear_velocity: Float[Array, "frames 3"]


def joint_states(
    arm: ArmArrays, qpos: Float[Array, " joints"], qvel: Float[Array, " joints"] | None = None
) -> JointStates:
    """Frames of the base and of each joint of an arm, one sample; batch with `jax.vmap`.

    Args:
      arm: the arm.
      qpos: joint angles [rad].
      qvel: joint velocities [rad/s]; zero where None.
    """
    angles = qpos + arm.reference
    cosine, sine = jnp.cos(angles), jnp.sin(angles)
    rotation = spatial.rotation(arm.base_rotation)
    origin, omega, linear = spatial.vector(arm.base_position), spatial.ZERO, spatial.ZERO
    rows: list[Any] = [(*sum(spatial.IDENTITY, ()), *spatial.ZERO, *spatial.ZERO, *spatial.ZERO)]
    for i in range(MAX_JOINTS):
        x, y, z = spatial.transpose(rotation)
        if i > 0:
            y, z = _turned(arm.twist[i], y, z)
            step = spatial.add(spatial.scale(arm.offset[i, 0], x), spatial.scale(arm.offset[i, 1], y))
            origin = spatial.add(origin, step)
            linear = spatial.add(linear, spatial.cross(omega, step))
        x, y = _turned((cosine[i], sine[i]), x, y)
        rotation = spatial.transpose((x, y, z))
        omega = omega if qvel is None else spatial.add(omega, spatial.scale(qvel[i], z))
        rows.append((*sum(rotation, ()), *origin, *omega, *linear))
    table = spatial.stack(rows, qpos.dtype)
    return JointStates(table[:, :9].reshape(-1, 3, 3), table[:, 9:12], table[:, 12:15], table[:, 15:])


def _turned(turn: Any, x: spatial.Vector, y: spatial.Vector) -> tuple[spatial.Vector, spatial.Vector]:
    """The axes x and y of a frame after a rotation about z by an angle with this cosine and sine."""
    cosine, sine = turn[0], turn[1]
    return (
        spatial.add(spatial.scale(cosine, x), spatial.scale(sine, y)),
        spatial.subtract(spatial.scale(cosine, y), spatial.scale(sine, x)),
    )


def link_states(
    arm: ArmArrays, qpos: Float[Array, " joints"], qvel: Float[Array, " joints"] | None = None
) -> LinkStates:
    """Link states as of `mimic.link_states`, normalized by the chain length; empty slots of links are at the base.

    Args:
      arm: the arm.
      qpos: joint angles [rad].
      qvel: joint velocities [rad/s]; zero where None.
    """
    return link_states_in_frames(arm, joint_states(arm, qpos, qvel))


def link_states_in_frames(arm: ArmArrays, frames: JointStates) -> LinkStates:
    """Link states from the frames of the joints."""
    of_link = jax.tree.map(lambda x: x[arm.link_joint + 1], frames)
    arms = _rotated(of_link.rotation, arm.link_position)
    unit = 1 / arm.chain_length
    return LinkStates(
        position=unit * (of_link.origin + arms),
        direction=_rotated(of_link.rotation, arm.link_direction),
        linear_velocity=unit * (of_link.linear_velocity + jnp.cross(of_link.angular_velocity, arms)),
        angular_velocity=of_link.angular_velocity,
    )


def _rotated(rotation: Float[Array, "n 3 3"], vectors: Float[Array, "n 3"]) -> Float[Array, "n 3"]:
    return jnp.sum(rotation * vectors[:, None, :], axis=-1)  # elementwise: no TF32


def correspondence(expert: ArmArrays, learner: ArmArrays) -> Float[Array, "expert learner"]:
    """Correspondence by arc length, see `mimic.arc_length_correspondence`; 0 for empty slots of links."""
    overlap = overlaps_of_chains(expert.link_length, learner.link_length, jnp)[0]
    return overlap.size * overlap / overlap.sum()


def check_metric(config: MetricConfig) -> DistanceWeights:
    """The weights of a metric between any arms.

    Raises:
      ValueError: a metric other than constant weights with the correspondence by arc length.
    """
    weights = config.make_weights()
    expected = {"correspondence": "arc_length", "reduction": "mean", "rotation_measure": "cosine", "links": "kept"}
    different = [f"{key}={getattr(config, key)}" for key, value in expected.items() if getattr(config, key) != value]
    if different or not isinstance(weights, DistanceWeights):
        raise ValueError(
            "metric: expected the default one, with any constant weights, for arms as arrays, got "
            + (", ".join(different) or f"adaptive={config.adaptive}, link_distance={config.link_distance!r}")
        )
    return weights


def make_metric(weights: DistanceWeights, matrix: Float[Array, "expert learner"]) -> Metric:
    """The metric with these weights and this correspondence."""
    return Metric(matrix, weights, "cosine", "mean")


class Jacobians(NamedTuple):
    """Derivatives of the positions and directions of the links by the joint angles; 0 for locked joints.

    Attributes:
      position: [joints, links, 3] in chain lengths.
      direction: [joints, links, 3].
    """

    position: Float[Array, "joints links 3"]
    direction: Float[Array, "joints links 3"]


def link_jacobians(arm: ArmArrays, frames: JointStates, states: LinkStates) -> Jacobians:
    """Jacobians of the links, from the axes of the joints."""
    axes = frames.rotation[1:, None, :, 2]
    arms = states.position - frames.origin[1:, None] / arm.chain_length
    moves = (jnp.arange(MAX_JOINTS)[:, None] <= arm.link_joint) * arm.is_free[:, None]
    assert states.direction is not None
    return Jacobians(
        moves[..., None] * jnp.cross(axes, arms), moves[..., None] * jnp.cross(axes, states.direction[None])
    )
