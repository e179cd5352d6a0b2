"""Plot of demonstrations: angle, velocity and torque of each joint, with its limits."""

from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure

from mimic.arms.embodiment import Embodiment
from mimic.motions.demonstrations import Demonstrations

_COLOURS = {"angle": "tab:blue", "gripper": "tab:brown", "velocity": "tab:green", "torque": "tab:purple"}
_WIDTH, _HEIGHT = 1.7, 2.2  # inches of a panel


def plot_demonstrations(demonstrations: Demonstrations, arm: Embodiment, out: Path, *, title: str) -> None:
    """Plots a column of time series for each joint; limits within the panels are dashed.

    Args:
      demonstrations: demonstrations of the arm. Their torques and their gripper get a row if they are known.
      arm: arm whose limits are drawn.
      out: file of the plot.
      title: title of the plot.
    """
    velocity, torque = ([(-limit, limit) for limit in limits] for limits in (arm.velocity_limit, arm.torque_limit))
    rows = [("angle [rad]", demonstrations.qpos, arm.joint_range), ("velocity [rad/s]", demonstrations.qvel, velocity)]
    if demonstrations.gripper is not None:
        rows.insert(1, ("gripper", demonstrations.gripper, ()))  # between others, since the lowest row has the times
    if demonstrations.torque is not None:
        rows.append(("torque [N m]", demonstrations.torque, torque))
    size = _WIDTH * arm.num_joints + 0.6, _HEIGHT * len(rows) + 0.6
    figure = Figure(figsize=size, layout="constrained")
    panels = figure.subplots(len(rows), arm.num_joints, sharex=True, sharey="row", squeeze=False)
    time = demonstrations.dt * np.arange(demonstrations.horizon + 1)
    for (label, values, limits), row in zip(rows, panels, strict=True):
        row[0].set_ylabel(label)
        for axes in row[values.shape[-1] :]:
            axes.set_visible(False)
        for joint, axes in enumerate(row[: values.shape[-1]]):
            _draw(axes, time[: values.shape[1]], values[..., joint], _COLOURS[label.split()[0]])
            axes.grid(alpha=0.3)
        height = row[0].get_ylim()  # shared: of all joints
        for axes, (lower, upper) in zip(row, limits, strict=False):
            for limit in (lower, upper):
                if height[0] <= limit <= height[1]:
                    axes.axhline(limit, color="tab:red", lw=0.8, ls="--")
    for axes, name in zip(panels[0], arm.joint_names, strict=True):
        axes.set_title(name)
    for axes, name in zip(panels[1], demonstrations.gripper_names, strict=False):
        axes.set_title(name, fontsize="small")
    for axes in panels[-1]:
        axes.set_xlabel("time [s]")
    figure.suptitle(f"{title} (limits dashed)")
    figure.savefig(out, dpi=150)


def _draw(axes: Any, time: np.ndarray, values: Float[np.ndarray, "demonstrations time"], colour: str) -> None:
    """Draws thin lines as one artist: hundreds of artists take seconds. Few lines stay distinct, many show density."""
    lines = np.stack([np.broadcast_to(time, values.shape), values], axis=-1)
    opacity = float(np.clip(40 / len(values), 0.35, 0.9))
    axes.add_collection(LineCollection(list(lines), color=colour, lw=0.6, alpha=opacity))
    axes.autoscale_view()
