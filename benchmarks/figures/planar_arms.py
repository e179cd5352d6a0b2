"""Drawing of planar arms, shared by all figures."""

from collections.abc import Sequence
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float
from matplotlib.lines import Line2D

from mimic.arms.embodiment import Embodiment
from mimic.arms.link_match import Colour, LinkMatch
from mimic.metric.kinematics import forward_kinematics

EXPERT_COLOUR, LEARNER_COLOUR = "tab:blue", "tab:orange"
_JOINT = "#333333"
_GHOST: dict[str, Any] = {"lw": 13, "alpha": 0.35}
_LEARNER: dict[str, Any] = {"lw": 5, "alpha": 1.0}
_MARGIN = 0.12  # chain lengths around arms


def joint_points(arm: Embodiment, qpos: Any) -> Float[np.ndarray, "points 2"]:
    """Positions of base, joints and tip of a planar arm, scaled to chain length 1."""
    direction = np.asarray(forward_kinematics(arm, jnp.asarray(qpos)).rotation)[:, :2, 0]
    ends = np.cumsum(direction * np.asarray(arm.link_lengths)[:, None], axis=0)
    return np.concatenate([np.zeros((1, 2)), ends]) / float(arm.chain_length)


def draw_arm(
    axes: Any, arm: Embodiment, qpos: Any, colour: str, label: str, *, width: float = 3, alpha: float = 1
) -> None:
    """Draws a planar arm, scaled to chain length 1."""
    style: dict[str, Any] = {"color": colour, "lw": width, "ms": width + 2, "alpha": alpha, "solid_capstyle": "round"}
    axes.plot(*joint_points(arm, qpos).T, "-o", label=label, **style)


def draw_match(axes: Any, match: LinkMatch, expert_qpos: Any, learner_qpos: Any) -> None:
    """Draws a planar learner over a ghost of its expert, both of chain length 1; matching links have one colour."""
    _draw_links(axes, joint_points(match.expert, expert_qpos), list(match.expert_colours.values()), _GHOST)
    _draw_links(axes, joint_points(match.learner, learner_qpos), list(match.learner_colours.values()), _LEARNER)


def _draw_links(
    axes: Any, points: Float[np.ndarray, "points 2"], colours: Sequence[Colour], style: dict[str, Any]
) -> None:
    for start, end, colour in zip(points[:-1], points[1:], colours, strict=True):
        axes.plot(*zip(start, end, strict=True), color=colour, solid_capstyle="round", **style)
    axes.plot(*points.T, "o", color=_JOINT, ms=0.6 * style["lw"] + 2, alpha=style["alpha"], mew=0)


def add_match_legend(figure: Any, *more: Any) -> None:
    """Adds a legend of `draw_match` below all axes, with further lines."""
    styles = ("expert", {**_GHOST, "lw": 9}), ("learner", _LEARNER)
    lines = [Line2D([], [], label=label, color="0.35", **style) for label, style in styles]
    title = "links of the same colour correspond"
    handles = [*lines, *more]
    figure.legend(handles=handles, loc="outside lower center", ncols=len(handles), frameon=False, title=title)


def fit(all_axes: Sequence[Any]) -> None:
    """Sets the limits of axes to their arms, at one scale for all, without ticks and frames."""
    for axes in all_axes:
        axes.relim()
    boxes = np.array([axes.dataLim.get_points() for axes in all_axes])
    half = (boxes[:, 1] - boxes[:, 0]).max(axis=0) / 2 + _MARGIN
    for axes, middle in zip(all_axes, boxes.mean(axis=1), strict=True):
        limits = zip(middle - half, middle + half, strict=True)
        axes.set(**dict(zip(("xlim", "ylim"), limits, strict=True)), aspect="equal", xticks=[], yticks=[])
        axes.spines[:].set_visible(False)
