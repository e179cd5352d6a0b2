"""Similarity of two arms given as arrays: the measures of `mimic.metric.similarity` in one compiled function."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from mimic.arms.arrays import ArmArrays
from mimic.metric.array_kinematics import link_states
from mimic.metric.similarity import SAMPLES, CentreLine, similarity


def centre_line(arm: ArmArrays, qpos: Float[Array, " joints"], *, samples: int = SAMPLES) -> CentreLine:
    """Centre line of an arm in one pose, see `mimic.metric.similarity.centre_line`.

    Its segments are the links. So the centre line of an arm with merged links is that of their chords.

    Args:
      arm: the arm.
      qpos: joint angles [rad].
      samples: number of points at equal arc length.

    Raises:
      ValueError: `samples` is below 1.
    """
    if samples < 1:
        raise ValueError(f"samples: expected at least 1, got {samples}")
    states = link_states(arm, qpos)
    middle, direction = states.position, states.direction
    assert direction is not None
    lengths = jnp.asarray(arm.link_length / arm.chain_length, qpos.dtype)
    # Empty slots have length 0, so that none of the samples is on them.
    hand = jnp.max(jnp.where(lengths > 0, jnp.arange(len(lengths)), 0))
    ends = jnp.cumsum(lengths)
    arc = (jnp.arange(samples, dtype=lengths.dtype) + 0.5) / samples * ends[-1]
    index = jnp.minimum(jnp.sum(ends < arc[:, None], axis=1), hand)
    from_middle = arc - (ends - 0.5 * lengths)[index]
    points = middle[index] + from_middle[:, None] * direction[index]
    tip = middle[hand] + 0.5 * lengths[hand] * direction[hand]
    return CentreLine(points, direction[index], tip, direction[hand])


def motion_similarity(
    expert: ArmArrays,
    learner: ArmArrays,
    expert_qpos: Float[Array, "time joints"],
    learner_qpos: Float[Array, "time joints"],
    *,
    samples: int = SAMPLES,
) -> dict[str, Float[Array, " time"]]:
    """The measures of `mimic.metric.similarity.similarity` at each time; batch with `jax.vmap`.

    Args:
      expert: the arm that is imitated.
      learner: the arm that imitates.
      expert_qpos: the expert's angles, those of its locked joints included [rad].
      learner_qpos: the learner's angles at the same times [rad].
      samples: number of points on each centre line.

    Returns:
      A value [T] for each name in `MEASURES`: distances in chain lengths, angles in degrees.
    """

    def lines(arm: ArmArrays, qpos: Array) -> CentreLine:
        return jax.vmap(lambda pose: centre_line(arm, pose, samples=samples))(qpos)

    return similarity(lines(expert, expert_qpos), lines(learner, learner_qpos))
