"""Figure that explains the similarity measures on two planar arms."""

from typing import Any

import matplotlib.patches
import numpy as np

from benchmarks.figures.canvas import plt
from benchmarks.figures.planar_arms import EXPERT_COLOUR, LEARNER_COLOUR, draw_arm
from mimic.arms.embodiment import planar_arm
from mimic.metric.similarity import MEASURES, CentreLine, centre_line_table, similarity

_EXPERT, _LEARNER = planar_arm([0.4, 0.35, 0.25]), planar_arm([0.55, 0.45])
_EXPERT_POSE, _LEARNER_POSE = np.array([1.9, -1.1, -1.0]), np.array([0.6, 0.9])
_SAMPLES = 32  # of each centre line
_ARROW = 0.13  # chain lengths
_TITLES = (
    "1  centre-line distance",
    "2  tangent angle",
    "3  Fréchet distance",
    "4  hand position",
    "5  hand direction",
)


def draw_similarity() -> Any:
    """Draws two planar arms in five panels: each panel shows one measure and its value."""
    lines = [
        centre_line_table(arm, pose, samples=_SAMPLES)
        for arm, pose in ((_EXPERT, _EXPERT_POSE), (_LEARNER, _LEARNER_POSE))
    ]
    values = similarity(*lines)
    figure, panels = plt.subplots(1, len(_TITLES), figsize=(14, 3.3), layout="constrained", sharex=True, sharey=True)
    draws = (_draw_distances, _draw_tangents, _draw_frechet, _draw_hands, _draw_hand_directions)
    for axes, draw, name, title in zip(panels, draws, MEASURES[: len(_TITLES)], _TITLES, strict=True):
        draw_arm(axes, _EXPERT, _EXPERT_POSE, EXPERT_COLOUR, "expert", width=4, alpha=0.35)
        draw_arm(axes, _LEARNER, _LEARNER_POSE, LEARNER_COLOUR, "learner", width=4, alpha=0.35)
        draw(axes, *lines)
        value = float(values[name])
        axes.set_title(f"{title}: {value:.0f}°" if name.endswith("deg") else f"{title}: {value:.2f}", fontsize="medium")
        axes.set(aspect="equal", xticks=[], yticks=[])
    panels[0].margins(0.1)
    panels[0].legend(fontsize="small", loc="lower right")
    return figure


def _draw_distances(axes: Any, expert: CentreLine, learner: CentreLine) -> None:
    for pair in zip(expert.points[1::3], learner.points[1::3], strict=True):
        axes.plot(*np.transpose(pair)[:2], "-", color="black", lw=1)


def _draw_tangents(axes: Any, expert: CentreLine, learner: CentreLine) -> None:
    """Draws both tangents at some points of the expert."""
    for sample in range(3, _SAMPLES, 5):
        point = expert.points[sample, :2]
        for line, colour in ((expert, EXPERT_COLOUR), (learner, LEARNER_COLOUR)):
            _draw_arrow(axes, point, line.tangents[sample, :2], colour)
        _draw_angle(axes, point, expert.tangents[sample, :2], learner.tangents[sample, :2])


def _draw_frechet(axes: Any, expert: CentreLine, learner: CentreLine) -> None:
    """Draws pairs of points of the optimal coupling, and the pair with the maximum distance."""
    distances = np.linalg.norm(expert.points[:, None] - learner.points[None], axis=-1)
    coupling = _optimal_coupling(distances)
    for i, j in coupling[1::5]:
        axes.plot(*np.transpose([expert.points[i, :2], learner.points[j, :2]]), "-", color="grey", lw=0.8)
    i, j = max(coupling, key=lambda pair: distances[pair])
    axes.plot(*np.transpose([expert.points[i, :2], learner.points[j, :2]]), "-", color="black", lw=2)


def _optimal_coupling(distances: np.ndarray) -> list[tuple[int, int]]:
    """Monotone pairs of samples along both lines whose maximum distance is minimal: the discrete Fréchet coupling."""
    cost = np.full((len(distances) + 1, distances.shape[1] + 1), np.inf)
    cost[0, 0] = 0
    for i, j in np.ndindex(distances.shape):
        cost[i + 1, j + 1] = max(distances[i, j], min(cost[i, j], cost[i, j + 1], cost[i + 1, j]))
    coupling = [(len(distances) - 1, distances.shape[1] - 1)]
    while coupling[-1] != (0, 0):
        i, j = coupling[-1]
        previous = [(i - 1, j - 1), (i - 1, j), (i, j - 1)]
        valid = (pair for pair in previous if min(pair) >= 0)
        coupling.append(min(valid, key=lambda pair: (cost[pair[0] + 1, pair[1] + 1], distances[pair])))
    return coupling[::-1]


def _draw_hands(axes: Any, expert: CentreLine, learner: CentreLine) -> None:
    axes.plot(*np.transpose([expert.hand_position, learner.hand_position])[:2], "-", color="black", lw=2)


def _draw_hand_directions(axes: Any, expert: CentreLine, learner: CentreLine) -> None:
    corner = expert.hand_position[:2]
    for line, colour in ((expert, EXPERT_COLOUR), (learner, LEARNER_COLOUR)):
        _draw_arrow(axes, line.hand_position[:2], line.hand_direction[:2], colour)
    _draw_arrow(axes, corner, learner.hand_direction[:2], LEARNER_COLOUR)
    _draw_angle(axes, corner, expert.hand_direction[:2], learner.hand_direction[:2])


def _draw_arrow(axes: Any, point: np.ndarray, direction: np.ndarray, colour: str) -> None:
    tip = {"head_width": 0.03, "length_includes_head": True, "width": 0.007, "zorder": 3}
    axes.arrow(*point, *(_ARROW * direction), color=colour, **tip)


def _draw_angle(axes: Any, corner: np.ndarray, first: np.ndarray, second: np.ndarray) -> None:
    start, end = (float(np.degrees(np.arctan2(*direction[::-1]))) for direction in (first, second))
    if (end - start) % 360 > 180:
        start, end = end, start
    size = 1.1 * _ARROW
    arc = matplotlib.patches.Arc((float(corner[0]), float(corner[1])), size, size, theta1=start, theta2=end, lw=1.2)
    axes.add_patch(arc)
