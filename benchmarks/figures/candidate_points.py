"""Figure that compares candidate points and frames: which poses have distance 0 under each (paper, Fig. 2)."""

import dataclasses
from typing import Any

import numpy as np
from jaxtyping import Float

from benchmarks.figures.canvas import plt
from benchmarks.figures.planar_arms import EXPERT_COLOUR, LEARNER_COLOUR, joint_points
from mimic.arms.embodiment import Embodiment, planar_arm
from mimic.metric.distance import DistanceWeights, embodiment_distance
from mimic.metric.kinematics import candidate_points, link_states

_POSITIONS = DistanceWeights(translation=1.0, rotation=0.0)
_DIRECTIONS = DistanceWeights(translation=0.0, rotation=1.0)
_GOOD, _BAD = "tab:green", "tab:red"
_PERFECT = 1e-3  # chain lengths or rad; smaller distances are printed as 0.00
_ARROW = 0.11  # chain lengths
_WIDTHS = 13, 8  # line widths of upper arm and forearm [points]
_ROWS = -0.04, -0.12  # heights of the text below a panel, as fractions of the panel height


@dataclasses.dataclass(frozen=True, eq=False)
class PosedArm:
    """A planar arm at rest in a pose. Its frames are at the distal ends of its links, the last one at the hand.

    Attributes:
      arm: arm of chain length 1.
      qpos: joint positions [rad].
      parts: part of the arm that each link belongs to: 0 the upper arm, 1 the forearm.
    """

    arm: Embodiment
    qpos: Float[np.ndarray, " joints"]
    parts: Float[np.ndarray, " links"]


def poses() -> dict[str, PosedArm]:
    """Returns the expert, its mirror image about the line from base to hand, and an arm of two parallel links."""
    upper, forearm = np.radians([112, 8])
    four, two = np.array([upper, upper, forearm, forearm]), np.array([upper, forearm])
    arm, lengths = planar_arm([0.25] * 4, frame_at=1.0), np.full(4, 0.25)
    hand = lengths @ np.stack([np.cos(four), np.sin(four)], axis=1)
    mirrored = 2 * np.arctan2(hand[1], hand[0]) - four
    of_four, of_two = np.array([0, 0, 1, 1]), np.array([0, 1])
    return {
        "expert": PosedArm(arm, _joint_angles(four), of_four),
        "mirrored": PosedArm(arm, _joint_angles(mirrored), of_four),
        "parallel": PosedArm(planar_arm([0.3, 0.7], frame_at=1.0), _joint_angles(two), of_two),
    }


def distances(expert: PosedArm, learner: PosedArm) -> dict[str, float]:
    """Computes the embodiment distance with candidate points and with frames.

    - "points": distance between the hands, the only candidate point [chain lengths].
    - "frames": rotation distance of links in the same part of the arm, mean over all such pairs [rad].
    """
    states = link_states(expert.arm, expert.qpos), link_states(learner.arm, learner.qpos)
    points = candidate_points(states[0]), candidate_points(states[1])
    hand = np.zeros((expert.arm.num_links, learner.arm.num_links))
    hand[-1, -1] = 1
    same_part = (expert.parts[:, None] == learner.parts).astype(float)
    pairs = (hand, points, _POSITIONS), (same_part, states, _DIRECTIONS)
    # Algorithm 1 divides by the number of all pairs; W is scaled so that the mean is over the pairs in W only.
    values = [float(embodiment_distance(*frames, w * w.size / w.sum(), weights)) for w, frames, weights in pairs]
    return dict(zip(("points", "frames"), values, strict=True))


def draw_points() -> Any:
    """Draws a pose with distance 0 by points but not by frames, and a pose where it is the other way round."""
    learners = poses()
    figure, all_axes = plt.subplots(1, 3, figsize=(11, 5), sharex=True, sharey=True, layout="constrained")
    expert = learners.pop("expert")
    titles = "(a)  expert", "(b)  learner with its hand in the same place", "(c)  learner with parallel links"
    for axes, title in zip(all_axes, titles, strict=True):
        _draw(axes, expert, EXPERT_COLOUR, alpha=1 if axes is all_axes[0] else 0.22)
        axes.set_title(title, loc="left", fontsize="large")
        axes.set(aspect="equal", xticks=[], yticks=[])
        axes.spines[:].set_visible(False)
    for axes, learner in zip(all_axes[1:], learners.values(), strict=True):
        _draw(axes, learner, LEARNER_COLOUR, zorder=4)
        hands = np.array([joint_points(posed.arm, posed.qpos)[-1] for posed in (expert, learner)])
        axes.plot(*hands.T, "--", color="black", lw=1.2, zorder=9)
        axes.plot(*hands[0], "o", ms=17, mfc="none", mec="black", mew=1.2, zorder=9)
        _write_distances(axes, distances(expert, learner))
    all_axes[0].margins(0.08)
    for height, text in zip(
        _ROWS, ("thick: upper arm, thin: forearm", "circle: where the expert's hand is"), strict=True
    ):
        all_axes[0].text(0.02, height, text, transform=all_axes[0].transAxes, va="center")
    return figure


def _joint_angles(directions: np.ndarray) -> np.ndarray:
    """Joint angles of a planar arm whose links have these directions [rad]."""
    return np.diff(directions, prepend=0.0)


def _draw(axes: Any, posed: PosedArm, colour: str, *, alpha: float = 1.0, zorder: int = 0) -> None:
    """Draws the arm, with a thinner forearm and the x-axis of each link's frame as an arrow."""
    points = joint_points(posed.arm, posed.qpos)
    for part, start, end in zip(posed.parts, points[:-1], points[1:], strict=True):
        axes.plot(
            *np.transpose([start, end]),
            lw=_WIDTHS[part],
            color=colour,
            alpha=alpha,
            solid_capstyle="butt",
            zorder=zorder + 1,
        )
        middle, arrow = (start + end) / 2, _ARROW * (end - start) / np.linalg.norm(end - start)
        tip: dict[str, Any] = {"arrowstyle": "->", "color": "white", "lw": 1.6, "shrinkA": 0, "shrinkB": 0}
        axes.annotate("", middle + arrow / 2, middle - arrow / 2, arrowprops=tip, zorder=zorder + 2)
    axes.plot(*points[:-1].T, "o", color="white", mec=colour, mew=1.5, ms=8, alpha=max(alpha, 0.5), zorder=zorder + 2)
    axes.plot(*points[-1], "o", color=colour, ms=10, alpha=max(alpha, 0.5), zorder=zorder + 3)


def _write_distances(axes: Any, values: dict[str, float]) -> None:
    rows = ("by points (the hand):", "points", "chain lengths"), ("by frames (directions):", "frames", "rad")
    for height, (label, key, unit) in zip(_ROWS, rows, strict=True):
        value = values[key]
        text = f"{value:.2f} {unit}"
        axes.text(0.02, height, label, transform=axes.transAxes, va="center")
        style: dict[str, Any] = {"color": _GOOD if value < _PERFECT else _BAD, "weight": "bold"}
        axes.text(0.58, height, text, transform=axes.transAxes, va="center", **style)
