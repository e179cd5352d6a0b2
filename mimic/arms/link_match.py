"""Which links of two arms correspond, as colours and as overlays: the one place that chooses the colours of links.

The colours run along the expert from base to hand. A learner's link has the mean of the colours of the expert's links
that it corresponds to, weighted by their fractions; these are neighbours, so that the mean is a colour between theirs.
"""

import dataclasses
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from mimic.arms.embodiment import Embodiment
from mimic.control.clearance import body_poses

# The palettes of Okabe and Ito and of Tol (indigo), which colour-blind people tell apart. Red is left to locked joints.
PALETTE = "#332288", "#0072B2", "#56B4E9", "#009E73", "#F0E442", "#E69F00", "#CC79A7"  # base to hand
THRESHOLD = 0.3  # fraction of an expert's link in the target of a learner's link from which a line joins them
_GHOST_ALPHA, _LINE_ALPHA = 0.32, 0.9
_GHOST_RADIUS, _LINE_RADIUS = 0.035, 0.004  # chain lengths of the learner
_LINE_COLOUR = (0.15, 0.15, 0.15)

Colour = tuple[float, float, float]  # red, green, blue, from 0 to 1


class Capsule(NamedTuple):
    """A capsule between two points, in the learner's base frame [m]."""

    start: Float[np.ndarray, "3"]
    end: Float[np.ndarray, "3"]
    radius: float
    rgba: tuple[float, ...]


@dataclasses.dataclass(frozen=True, eq=False)
class LinkMatch:
    """Corresponding links of an expert and a learner.

    Attributes:
      expert, learner: the arms.
      fractions: fraction of each expert link in the target of a learner link; columns sum to 1.
    """

    expert: Embodiment
    learner: Embodiment
    fractions: Float[np.ndarray, "expert learner"]

    @property
    def expert_colours(self) -> dict[str, Colour]:
        """Colour of each link of the expert, by name."""
        return _by_name(self.expert, colours_along_arm(self.expert.num_links))

    @property
    def learner_colours(self) -> dict[str, Colour]:
        """Colour of each link of the learner, by name."""
        return _by_name(self.learner, self.fractions.T @ colours_along_arm(self.expert.num_links))

    def ghost(
        self,
        expert_qpos: Float[np.ndarray, " joints"],
        learner_qpos: Float[np.ndarray, " learner_joints"],
        base: Sequence[float] | None = None,
    ) -> list[Capsule]:
        """The expert's links, translucent, and lines to the learner's links.

        They are scaled to the learner's length, or with its base in the expert's base frame, [x, y, z, yaw] [m, rad],
        they are where the expert's are.
        """
        length, links = float(self.learner.chain_length), link_ends(self.expert, expert_qpos)
        if base is None:
            links = links * length / float(self.expert.chain_length)
        else:
            cosine, sine = np.cos(base[3]), np.sin(base[3])
            links = (links - base[:3]) @ np.array([[cosine, -sine, 0.0], [sine, cosine, 0.0], [0.0, 0.0, 1.0]])
        colours = colours_along_arm(self.expert.num_links)
        joined = [
            Capsule(start, end, _GHOST_RADIUS * length, (*colour, _GHOST_ALPHA))
            for (start, end), colour in zip(links, colours, strict=True)
        ]
        learner_links = link_ends(self.learner, learner_qpos)
        for expert_link, learner_link in zip(*np.nonzero(self.fractions >= THRESHOLD), strict=True):
            middles = links[expert_link].mean(axis=0), learner_links[learner_link].mean(axis=0)
            joined.append(Capsule(*middles, _LINE_RADIUS * length, (*_LINE_COLOUR, _LINE_ALPHA)))
        return joined


def colours_along_arm(count: int) -> Float[np.ndarray, "links 3"]:
    """Colours of the links of an expert, base to hand."""
    anchors = np.array([[int(colour[i : i + 2], 16) / 255 for i in (1, 3, 5)] for colour in PALETTE])
    positions = np.linspace(0, len(PALETTE) - 1, count) if count > 1 else np.zeros(1)
    return np.stack([np.interp(positions, range(len(PALETTE)), channel) for channel in anchors.T], axis=1)


def link_ends(arm: Embodiment, qpos: Float[np.ndarray, " joints"]) -> Float[np.ndarray, "links 2 3"]:
    """Start and end of each link in a pose [rad], in the base frame [m]; merged links are chords."""
    segments = [np.flatnonzero(np.asarray(arm.segment_link) == link)[[0, -1]] for link in range(arm.num_links)]
    first, last = np.transpose(segments)
    points = np.stack([np.asarray(arm.segment_start)[first], np.asarray(arm.segment_end)[last]], axis=1)
    rotations, shifts = _body_poses(arm, qpos)
    body = np.array(arm.link_joint) + 1
    return points @ np.swapaxes(rotations[body], 1, 2) + shifts[body, None]


def hand_poses(arm: Embodiment, qpos: Float[np.ndarray, "*batch joints"]) -> Float[np.ndarray, "*batch hands 4 4"]:
    """The hand frame of each chain in poses [rad], in the base frame [m], by NumPy alone."""
    rotations, shifts = _body_poses(arm, qpos)
    body = np.array(arm.hand_joint, int) + 1
    rotation, position = rotations[..., body, :, :], np.asarray(arm.hand_position, float)[..., None]
    poses = np.zeros((*rotation.shape[:-2], 4, 4))
    poses[..., :3, :3] = rotation @ np.asarray(arm.hand_rotation, float)
    poses[..., :3, 3] = (rotation @ position)[..., 0] + shifts[..., body, :]
    poses[..., 3, 3] = 1.0
    return poses


def _body_poses(arm: Embodiment, qpos: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """See `body_poses`."""
    axis, anchor = np.asarray(arm.joint_axis, float), np.asarray(arm.joint_anchor, float)
    return body_poses(np.asarray(qpos, float), arm.joint_parent, axis, anchor)


def _by_name(arm: Embodiment, colours: Float[np.ndarray, "links 3"]) -> dict[str, Colour]:
    """Colours by the names of links; a merged link has the names of its parts."""
    return {
        part: (float(red), float(green), float(blue))
        for name, (red, green, blue) in zip(arm.link_names, colours, strict=True)
        for part in name.split("+")
    }
