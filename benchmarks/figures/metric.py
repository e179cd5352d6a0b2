"""Figures that explain the metric: link frames, distances and correspondence matrices."""

import functools
from collections.abc import Callable
from typing import Any

import matplotlib.patches
import numpy as np

from benchmarks.figures.canvas import plt
from benchmarks.figures.planar_arms import EXPERT_COLOUR, LEARNER_COLOUR, draw_arm
from mimic.arms.embodiment import Embodiment, planar_arm
from mimic.metric.correspondence import (
    arc_length_correspondence,
    hard_correspondence,
    overlap_correspondence,
    soft_correspondence,
)
from mimic.metric.distance import DistanceWeights, link_distances
from mimic.metric.kinematics import link_states

_EXPERT, _LEARNER = planar_arm([0.4, 0.35, 0.25]), planar_arm([0.55, 0.45])
_EXPERT_POSE, _LEARNER_POSE = np.array([1.9, -1.1, -1.0]), np.array([1.2, -1.0])
_PAIR = 1, 0  # the links whose distance is drawn
_ARROW = 0.14  # chain lengths
_XI = -3.0
_TRANSLATION, _ROTATION = DistanceWeights(translation=1.0, rotation=0.0), DistanceWeights(translation=0.0, rotation=1.0)


def draw_links() -> Any:
    """Draws two arms with the frames of their links, and the position and rotation distances of all pairs of links."""
    figure, (arms, *maps) = plt.subplots(1, 3, figsize=(10, 3.4), layout="constrained", width_ratios=(1.5, 1, 1))
    positions, directions = [], []
    for arm, pose, colour, label in (
        (_EXPERT, _EXPERT_POSE, EXPERT_COLOUR, "expert"),
        (_LEARNER, _LEARNER_POSE, LEARNER_COLOUR, "learner"),
    ):
        draw_arm(arms, arm, pose, colour, label, width=4, alpha=0.45)
        states = link_states(arm, pose)
        positions.append(np.asarray(states.position)[:, :2])
        directions.append(np.asarray(states.direction)[:, :2])
        tip = {"head_width": 0.025, "length_includes_head": True, "width": 0.006, "zorder": 3}
        for number, (position, direction) in enumerate(zip(positions[-1], directions[-1], strict=True), start=1):
            arms.arrow(*position, *(_ARROW * direction), color=colour, **tip)
            sideways = np.array([-direction[1], direction[0]])
            arms.text(*(position + 0.06 * sideways), str(number), color=colour, ha="center", va="center")
    a, b = positions[0][_PAIR[0]], positions[1][_PAIR[1]]
    arms.plot(*np.transpose([a, b]), "--", color="black", lw=1)
    arms.text(*((a + b) / 2 + (0.02, 0.025)), r"$d_{tr}$", ha="left")
    _draw_angle(arms, b, directions[0][_PAIR[0]], directions[1][_PAIR[1]])
    arms.set(aspect="equal", xticks=[], yticks=[], title="links are compared by their frames")
    arms.margins(0.12)
    arms.legend(fontsize="small", loc="lower right")
    states = link_states(_EXPERT, _EXPERT_POSE), link_states(_LEARNER, _LEARNER_POSE)
    for axes, weights, title in zip(
        maps, (_TRANSLATION, _ROTATION), (r"$d_{tr}$ [chain lengths]", r"$d_{rot}$ [rad]"), strict=True
    ):
        _draw_matrix(axes, np.asarray(link_distances(*states, weights)), title)
    return figure


def draw_correspondence() -> Any:
    """Draws both chains on [0, 1], and correspondence matrices W from overlap and from the distances in one pose."""
    ratios = 1.6, 1, 1, 1, 1
    figure, (chains, *maps) = plt.subplots(1, 5, figsize=(13, 3), layout="constrained", width_ratios=ratios)
    for height, arm, colour, label in ((1, _EXPERT, EXPERT_COLOUR, "expert"), (0, _LEARNER, LEARNER_COLOUR, "learner")):
        _draw_chain(chains, arm, height, colour)
        chains.text(-0.03, height, label, ha="right", va="center", color=colour)
    chains.set(xlim=(-0.3, 1.02), ylim=(-0.5, 1.5), yticks=[], xticks=[0, 0.5, 1], title="both chains on [0, 1]")
    chains.spines[["left", "right", "top"]].set_visible(False)
    states = link_states(_EXPERT, _EXPERT_POSE), link_states(_LEARNER, _LEARNER_POSE)
    distances = link_distances(*states, _ROTATION)
    soft: Callable[..., Any] = functools.partial(soft_correspondence, xi=_XI)
    matrices = {
        "arc length (default)": arc_length_correspondence(_EXPERT, _LEARNER),
        "overlap": overlap_correspondence(_EXPERT, _LEARNER),
        "hard": hard_correspondence(distances),
        rf"soft, $\xi = {_XI:g}$": soft(distances),
    }
    for axes, (title, matrix) in zip(maps, matrices.items(), strict=True):
        _draw_matrix(axes, np.asarray(matrix), f"W: {title}")
    return figure


def _draw_angle(axes: Any, corner: np.ndarray, first: np.ndarray, second: np.ndarray) -> None:
    """Draws the angle between two directions at the start of the second one."""
    axes.plot(*np.transpose([corner, corner + 1.4 * _ARROW * first]), ":", color="black", lw=1)
    angles = np.degrees([np.arctan2(*direction[::-1]) for direction in (first, second)])
    low, high = sorted(angles)
    axes.add_patch(
        matplotlib.patches.Arc(
            (float(corner[0]), float(corner[1])), 1.4 * _ARROW, 1.4 * _ARROW, theta1=low, theta2=high, lw=1
        )
    )
    middle = np.radians((low + high) / 2)
    axes.text(*(corner + 1.05 * _ARROW * np.array([np.cos(middle), np.sin(middle)])), r"$\beta$", va="center")


def _draw_chain(axes: Any, arm: Embodiment, height: float, colour: str) -> None:
    ends = np.concatenate([[0], np.cumsum(np.asarray(arm.link_lengths))]) / float(arm.chain_length)
    for number, (start, end) in enumerate(zip(ends[:-1], ends[1:], strict=True), start=1):
        axes.barh(height, end - start, left=start, height=0.5, color=colour, alpha=0.45, edgecolor="black")
        axes.text((start + end) / 2, height, str(number), ha="center", va="center")


def _draw_matrix(axes: Any, matrix: np.ndarray, title: str) -> None:
    axes.imshow(matrix, cmap="viridis", vmin=0)
    for (row, column), value in np.ndenumerate(matrix):
        is_light = value > 0.6 * matrix.max()
        axes.text(column, row, f"{value:.2f}", ha="center", va="center", color="black" if is_light else "white")
    rows, columns = matrix.shape
    axes.set(xticks=range(columns), yticks=range(rows), title=title, xlabel="learner link", ylabel="expert link")
    axes.set_xticklabels(range(1, columns + 1))
    axes.set_yticklabels(range(1, rows + 1))
