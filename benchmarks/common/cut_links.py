"""Cuts two arms where either has a vertex, so that each piece of one corresponds to one piece of the other."""

import dataclasses

import numpy as np
from jaxtyping import Float

from mimic.arms.chain_match import matched_chains
from mimic.arms.embodiment import Embodiment, segment_arm

_SHORTEST = 1e-3  # of a chain, that a cut leaves of a segment


def cut_alike(expert: Embodiment, learner: Embodiment) -> tuple[Embodiment, Embodiment]:
    """Both arms with links that are cut where a corresponding chain of the other arm has a vertex.

    By arc length, overlapping links then cover the same interval of their chains, and have their middles at the same
    arc length: where the links of one arm are long, the distance compares positions at more places.

    Args:
      expert: the first arm; joints and shape stay as they are, links are pieces of straight segments.
      learner: the second arm, likewise.

    Raises:
      ValueError: trees whose chains do not match.
    """
    arms = segment_arm(expert), segment_arm(learner)
    vertices = [[_vertices(arm, chain) for chain in arm.chains] for arm in arms]
    cuts: list[list[set[float]]] = [[{0.0, 1.0} for _ in arm.segment_link] for arm in arms]
    for pair in matched_chains(expert.chain_names, learner.chain_names):
        for own in (0, 1):
            chain, own_vertices = arms[own].chains[pair[own]], vertices[own][pair[own]]
            _add_cuts(cuts[own], chain, own_vertices, vertices[1 - own][pair[1 - own]])
    return _cut(arms[0], cuts[0]), _cut(arms[1], cuts[1])


def _vertices(arm: Embodiment, chain: tuple[int, ...]) -> Float[np.ndarray, " vertices"]:
    """Arc lengths of the vertices of a chain, from 0 at the base to 1 at the tip."""
    ends = np.cumsum(np.asarray(arm.link_lengths)[list(chain)])
    return np.concatenate([[0.0], ends / ends[-1]])


def _add_cuts(cuts: list[set[float]], chain: tuple[int, ...], own: np.ndarray, other: np.ndarray) -> None:
    """Adds fractions of a chain's segments at which the other chain has a vertex."""
    for segment, start, end in zip(chain, own[:-1], own[1:], strict=True):
        inside = other[(other > start + _SHORTEST) & (other < end - _SHORTEST)]
        cuts[segment] |= set(((inside - start) / (end - start)).tolist())


def _cut(arm: Embodiment, cuts: list[set[float]]) -> Embodiment:
    """The arm, whose links are its segments, with these cut at fractions of their length."""
    pieces = [
        (segment, low, high)
        for segment, fractions in enumerate(map(sorted, cuts))
        for low, high in zip(fractions[:-1], fractions[1:], strict=True)
    ]
    segment, low, high = (np.array(column) for column in zip(*pieces, strict=True))
    first, along = np.asarray(arm.segment_start)[segment], np.asarray(arm.segment_end - arm.segment_start)[segment]
    start, end = first + low[:, None] * along, first + high[:, None] * along
    numbers = range(len(pieces))
    return dataclasses.replace(
        arm,
        link_position=(start + end) / 2,
        link_rotation=np.asarray(arm.link_rotation)[segment],
        link_lengths=np.linalg.norm(end - start, axis=1),
        link_names=tuple(f"piece{number + 1}" for number in numbers),
        link_joint=tuple(arm.link_joint[i] for i in segment),
        segment_start=start,
        segment_end=end,
        segment_link=tuple(numbers),
        chains=tuple(tuple(number for number in numbers if segment[number] in chain) for chain in arm.chains),
    )
