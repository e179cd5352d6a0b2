"""Similarity of two arms: measures on their centre lines and hands, which no metric and no trainer optimises.

An arm's centre line is the polyline of its segments from base to tip, in units of its own length; its hand is the tip.
The measures thus compare arms of different size and number of links, independently of the metric that was optimised.
They assume that both base frames coincide. Those of trees are means over the pairs of corresponding chains.
"""

import dataclasses
from types import ModuleType
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jax.typing import ArrayLike
from jaxtyping import Array, Float

from mimic.arms.arrays import ArmArrays
from mimic.arms.chain_match import matched_chains
from mimic.arms.embodiment import Embodiment, segment_arm
from mimic.base.spatial import array_library
from mimic.metric.kinematics import LinkStates, link_state_table, link_states

SAMPLES = 64  # of a centre line
MEASURES = (
    "centre_line_distance",
    "tangent_angle_deg",
    "frechet_distance",
    "hand_position_error",
    "hand_angle_deg",
    "hand_rotation_deg",
)


@struct.dataclass
class CentreLine:
    """Centre line of an arm in one or many poses, in its base frame.

    Attributes:
      points: [*batch, samples, 3] middles of intervals of equal arc length, base to tip [chain lengths].
      tangents: [*batch, samples, 3] unit directions of the centre line at these points.
      hand_position: [*batch, 3] position of the tip [chain lengths].
      hand_direction: [*batch, 3] unit direction of the last segment.
      hand_axes: [*batch, 3, 3] unit x-, y- and z-axis of the hand frame; NaN where the hand is not known.
      chains: names of the chains of a tree, which has an axis of its chains behind those of the batch; none for one.
    """

    points: Float[Any, "*batch samples 3"]
    tangents: Float[Any, "*batch samples 3"]
    hand_position: Float[Any, "*batch 3"]
    hand_direction: Float[Any, "*batch 3"]
    hand_axes: Float[Any, "*batch 3 3"]
    chains: tuple[str, ...] = struct.field(pytree_node=False, default=())


def centre_line(
    arm: Embodiment | ArmArrays, qpos: Float[ArrayLike, "*batch joints"], *, samples: int = SAMPLES
) -> CentreLine:
    """Centre line of an arm in one pose, or in each pose of a batch.

    Args:
      arm: the embodiment, or an arm as data, whose segments are its links: of merged links, their chords.
      qpos: joint angles [rad].
      samples: number of points at equal arc length.

    Raises:
      ValueError: `qpos` is not [..., joints], or `samples` is below 1.
    """
    if isinstance(arm, ArmArrays):
        _check_samples(samples)
        states = link_states(arm, qpos, normalized=False)
        assert states.direction is not None
        lengths = jnp.asarray(arm.link_length, states.position.dtype)
        start = states.position - 0.5 * lengths[:, None] * states.direction
        assert states.hand is not None
        return _sampled_chain(start, states.direction, lengths, lengths.sum(), samples, states.hand.axes)
    return _sampled(arm, link_states(segment_arm(arm), qpos, normalized=False), samples)


def centre_line_table(
    arm: Embodiment, qpos: Float[np.ndarray, "*batch joints"], *, samples: int = SAMPLES
) -> CentreLine:
    """Centre lines of an arm in many poses, computed by NumPy in single precision; see `centre_line`."""
    segments = segment_arm(arm)
    length = float(segments.chain_length)
    states = link_state_table(segments, qpos, np.zeros_like(qpos))
    return _sampled(arm, dataclasses.replace(states, position=states.position * np.float32(length)), samples)


def _sampled(arm: Embodiment, segments: LinkStates, samples: int) -> CentreLine:
    """The centre line, from the starts [m] and directions of its segments."""
    _check_samples(samples)
    start, direction = segments.position, segments.direction
    assert direction is not None
    lengths = np.linalg.norm(np.asarray(arm.segment_end) - np.asarray(arm.segment_start), axis=1)
    numpy = array_library(start)
    shape = *start.shape[:-2], len(arm.chains), 3, 3
    axes = segments.hand.axes.reshape(shape) if segments.hand else numpy.full(shape, np.nan, start.dtype)
    if len(arm.chains) == 1:
        return _sampled_chain(start, direction, lengths, float(np.cumsum(lengths)[-1]), samples, axes[..., 0, :, :])
    reach = float(segment_arm(arm).chain_length)
    segment_chains = [np.array([s for s, link in enumerate(arm.segment_link) if link in chain]) for chain in arm.chains]
    lines = [
        _sampled_chain(start[..., own, :], direction[..., own, :], lengths[own], reach, samples, axes[..., i, :, :])
        for i, own in enumerate(segment_chains)
    ]
    points, tangents = (numpy.stack([getattr(line, name) for line in lines], -3) for name in ("points", "tangents"))
    position, direction = (
        numpy.stack([getattr(line, f"hand_{name}") for line in lines], -2) for name in ("position", "direction")
    )
    return CentreLine(points, tangents, position, direction, axes, chains=arm.chain_names)


def _check_samples(samples: int) -> None:
    if samples < 1:
        raise ValueError(f"samples: expected at least 1, got {samples}")


def _sampled_chain(start: Any, direction: Any, lengths: Any, reach: Any, samples: int, axes: Any) -> CentreLine:
    """The centre line of the segments of one chain.

    Args:
      start: [*batch, segments, 3] of the segments [m].
      direction: [*batch, segments, 3] unit vectors.
      lengths: [segments] of the segments [m]; 0 for empty slots, none of which has a sample.
      reach: length that is the unit of the result [m].
      samples: number of points.
      axes: [*batch, 3, 3] of the hand.
    """
    numpy, of_lengths = array_library(start), array_library(lengths)
    ends = of_lengths.cumsum(lengths)
    arc = (np.arange(samples) + 0.5) / samples * ends[-1]
    hand = of_lengths.max(of_lengths.where(lengths > 0, np.arange(len(lengths)), 0))
    index = of_lengths.minimum(of_lengths.sum(ends < arc[:, None], axis=1), hand)
    offset = (arc - (ends - lengths)[index]).astype(start.dtype)
    points = start[..., index, :] + offset[:, None] * direction[..., index, :]
    tip = start[..., hand, :] + numpy.asarray(lengths[hand], start.dtype) * direction[..., hand, :]
    unit = numpy.asarray(1 / reach, start.dtype)
    return CentreLine(unit * points, direction[..., index, :], unit * tip, direction[..., hand, :], axes)


def centre_line_distance(expert: CentreLine, learner: CentreLine) -> Float[Any, "*batch"]:
    """Mean distance between points at equal arc length [chain lengths].

    Args:
      expert: centre line of the expert.
      learner: centre line of the learner, with as many samples.
    """
    return _norm(expert.points - learner.points).mean(axis=-1)


def tangent_angle(expert: CentreLine, learner: CentreLine) -> Float[Any, "*batch"]:
    """Mean angle between the tangents at equal arc length [rad], in [0, pi].

    Args:
      expert: centre line of the expert.
      learner: centre line of the learner, with as many samples.
    """
    return _angle(expert.tangents, learner.tangents).mean(axis=-1)


def frechet_distance(expert: CentreLine, learner: CentreLine) -> Float[Any, "*batch"]:
    """Discrete Frechet distance of the centre lines [chain lengths] (Eiter and Mannila 1994).

    The minimum over monotone walks along both lines of the maximum distance. Unlike the other measures, it does not
    depend on the parametrisation of the lines.

    Args:
      expert: centre line of the expert.
      learner: centre line of the learner, with any number of samples.
    """
    numpy = array_library(expert.points)
    # [3, samples, *batch]: batches are contiguous, which is fast in NumPy.
    a, b = (numpy.moveaxis(line.points, (-1, -2), (0, 1)) for line in (expert, learner))
    return _frechet(a, b) if numpy is jnp else _frechet_numpy(a, np.ascontiguousarray(b))


def _frechet(a: Float[Array, "3 m *batch"], b: Float[Array, "3 n *batch"]) -> Float[Array, "*batch"]:
    """By rows [n, *batch] of the dynamic programme: distance of the lines up to a point of `a` and each of `b`."""

    def point_distances(point: Array) -> Array:
        return _norm(jnp.moveaxis(point[:, None] - b, 0, -1))

    def next_row(row: Array, point: Array) -> tuple[Array, None]:
        low = point_distances(point)
        return _running_clamp(low, jnp.maximum(low, _best_predecessor(row, jnp))), None

    first = jax.lax.cummax(point_distances(a[:, 0]), axis=0)
    return jax.lax.scan(next_row, first, jnp.moveaxis(a[:, 1:], 1, 0))[0][-1]


def _frechet_numpy(a: Float[np.ndarray, "3 m *batch"], b: Float[np.ndarray, "3 n *batch"]) -> Float[Any, "*batch"]:
    row = None
    for point in np.moveaxis(a, 1, 0):
        low = np.sqrt(sum((x - y) ** 2 for x, y in zip(point, b, strict=True)))
        if row is None:
            row = np.maximum.accumulate(low, axis=0)
            continue
        predecessor = _best_predecessor(row, np)
        row = np.maximum(low, predecessor)
        for j in range(1, len(row)):
            np.maximum(low[j], np.minimum(predecessor[j], row[j - 1]), out=row[j, ...])
    assert row is not None
    return row[-1]


def _best_predecessor(row: Any, numpy: ModuleType) -> Any:
    """Minimum of the two cells of the previous row from which a cell can be reached."""
    return numpy.concatenate([row[:1], numpy.minimum(row[1:], row[:-1])])


def _running_clamp(low: Array, high: Array) -> Array:
    """y_j = max(low_j, min(high_j, y_{j-1})) along the first axis, y_0 = high_0; high is nowhere below low."""

    def compose(first: tuple[Array, Array], second: tuple[Array, Array]) -> tuple[Array, Array]:
        return jnp.clip(first[0], second[0], second[1]), jnp.clip(first[1], second[0], second[1])

    return jax.lax.associative_scan(compose, (low, high))[1]


def hand_position_error(expert: CentreLine, learner: CentreLine) -> Float[Any, "*batch"]:
    """Distance between the tips [chain lengths]."""
    return _norm(expert.hand_position - learner.hand_position)


def hand_angle(expert: CentreLine, learner: CentreLine) -> Float[Any, "*batch"]:
    """Angle between the directions of the last segments [rad], in [0, pi]."""
    return _angle(expert.hand_direction, learner.hand_direction)


def hand_rotation(expert: CentreLine, learner: CentreLine) -> Float[Any, "*batch"]:
    """Angle of the rotation between the hand frames [rad], in [0, pi]; NaN where a hand is not known."""
    numpy, difference = array_library(expert.hand_axes), expert.hand_axes - learner.hand_axes
    chord = _norm(difference.reshape(*difference.shape[:-2], 9))  # |R - R_hat| = sqrt(8) sin(theta / 2)
    return 2 * numpy.arcsin(numpy.minimum(chord / np.sqrt(8), 1)).astype(difference.dtype)


def similarity(expert: CentreLine, learner: CentreLine) -> dict[str, Float[Any, "*batch"]]:
    """All measures by their names in `MEASURES`, angles in degrees; 0 means equal.

    Args:
      expert: centre line of the expert.
      learner: centre line of the learner, with as many samples.

    Raises:
      ValueError: trees whose chains do not match, see `matched_chains`.
    """
    degrees = 180 / np.pi
    is_tree = bool(expert.chains or learner.chains)
    if is_tree:
        expert, learner = _matched(expert, learner)
    values = (
        centre_line_distance(expert, learner),
        degrees * tangent_angle(expert, learner),
        frechet_distance(expert, learner),
        hand_position_error(expert, learner),
        degrees * hand_angle(expert, learner),
        degrees * hand_rotation(expert, learner),
    )
    if is_tree:
        values = tuple(value.mean(axis=-1) for value in values)
    return dict(zip(MEASURES, values, strict=True))


def _matched(expert: CentreLine, learner: CentreLine) -> tuple[CentreLine, CentreLine]:
    """Both lines with an axis of their corresponding chains."""
    lines = [line if line.chains else _with_chain(line) for line in (expert, learner)]
    pairs = np.array(matched_chains(lines[0].chains, lines[1].chains))
    matched = []
    for line, index in zip(lines, pairs.T, strict=True):
        points, tangents = line.points[..., index, :, :], line.tangents[..., index, :, :]
        hands = line.hand_position[..., index, :], line.hand_direction[..., index, :], line.hand_axes[..., index, :, :]
        matched.append(CentreLine(points, tangents, *hands))
    return matched[0], matched[1]


def _with_chain(line: CentreLine) -> CentreLine:
    parts = line.points[..., None, :, :], line.tangents[..., None, :, :]
    hands = line.hand_position[..., None, :], line.hand_direction[..., None, :], line.hand_axes[..., None, :, :]
    return CentreLine(*parts, *hands, chains=("arm",))


def _norm(vectors: Any) -> Any:
    """Length along the last axis, with derivative 0 at 0; NaN where an entry is."""
    numpy = array_library(vectors)
    square = (vectors * vectors).sum(axis=-1)
    return numpy.where(square == 0, 0, numpy.sqrt(numpy.where(square == 0, 1, square)))


def _angle(a: Any, b: Any) -> Any:
    """Angle between unit vectors, from their difference and sum: accurate at 0 and at pi."""
    return 2 * array_library(a).arctan2(_norm(a - b), _norm(a + b))
