"""Plot of demonstrations: angle, velocity and torque of each joint, and the path of the hand."""

from pathlib import Path
from typing import Any

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt  # noqa: E402
import numpy as np  # noqa: E402
from jaxtyping import Float  # noqa: E402
from matplotlib.collections import LineCollection  # noqa: E402

from mimic.arms.embodiment import Embodiment, segment_arm  # noqa: E402
from mimic.metric.similarity import centre_line_table  # noqa: E402
from mimic.motions.demonstrations import Demonstrations  # noqa: E402

_COLOURS = {"angle": "tab:blue", "velocity": "tab:green", "torque": "tab:purple", "hand": "tab:orange"}
_LIMIT: dict[str, Any] = {"color": "tab:red", "lw": 0.8, "ls": "--"}
_PANEL, _HAND_WIDTH, _HEIGHT = 1.7, 3.4, 6.8  # inches
_FLAT = 1e-6  # m, height range below which a path counts as horizontal


def peak(values: Float[np.ndarray, "demonstrations time joints"]) -> Float[np.ndarray, " joints"]:
    """Maximum magnitude of each joint."""
    return np.abs(values).max(axis=(0, 1))


def with_fraction(value: float, limit: float) -> str:
    """Text of a value and its fraction of a finite limit; a dash for NaN."""
    if np.isnan(value):
        return "-"
    return f"{value:.2f} ({value / limit:.0%})" if np.isfinite(limit) else f"{value:.2f}"


def hand_paths(
    arm: Embodiment, qpos: Float[np.ndarray, "demonstrations samples joints"]
) -> Float[np.ndarray, "demonstrations samples 3"]:
    """Position of the end of the last link in the base frame [m]."""
    return float(segment_arm(arm).chain_length) * centre_line_table(arm, qpos, samples=1).hand_position


def plot_demonstrations(demonstrations: Demonstrations, arm: Embodiment, out: Path, *, title: str) -> None:
    """Plots one column of time series for each joint, and the hand's paths in two views; limits are dashed.

    Args:
      demonstrations: demonstrations of the arm. Their torques get a row if they are known.
      arm: arm whose limits are drawn.
      out: file of the plot.
      title: title of the plot.
    """
    joints = arm.num_joints
    figure = plt.figure(figsize=(_PANEL * joints + _HAND_WIDTH, _HEIGHT), layout="constrained")
    subfigures: Any = figure.subfigures(1, 2, width_ratios=(_PANEL * joints, _HAND_WIDTH))
    left, right = subfigures
    figure.suptitle(f"{title} (limits dashed)")
    has_torque = demonstrations.torque is not None
    rows = left.subplots(2 + has_torque, joints, sharex=True, squeeze=False)
    _plot_angles(rows[0], demonstrations, arm)
    _plot_velocities(rows[1], demonstrations, arm)
    if has_torque:
        _plot_torques(rows[2], demonstrations, arm)
    for axes in rows.flat:
        axes.grid(alpha=0.3)
        axes.margins(x=0)
    for axes in rows[-1]:
        axes.set_xlabel("time [s]")
    _plot_hand(right, hand_paths(arm, demonstrations.qpos))
    figure.savefig(out, dpi=150)
    plt.close(figure)


def _plot_angles(row: Any, demonstrations: Demonstrations, arm: Embodiment) -> None:
    lower, upper = np.asarray(arm.joint_range).T
    margin = 0.05 * (upper.max() - lower.min())
    for joint, axes in enumerate(row):
        _plot_lines(axes, _times(demonstrations), demonstrations.qpos[..., joint], "angle")
        _plot_limits(axes, (lower[joint], upper[joint]))
        axes.set(ylim=(lower.min() - margin, upper.max() + margin), title=arm.joint_names[joint])
    _label_row(row, "angle [rad]")


def _plot_velocities(row: Any, demonstrations: Demonstrations, arm: Embodiment) -> None:
    limit, maximum = np.asarray(arm.velocity_limit), peak(demonstrations.qvel)
    height = 1.3 * max(maximum.max(), limit[np.isfinite(limit)].max(initial=0))  # with space for the note
    for joint, axes in enumerate(row):
        _plot_lines(axes, _times(demonstrations), demonstrations.qvel[..., joint], "velocity")
        _plot_limits(axes, (-limit[joint], limit[joint]))
        _note(axes, maximum[joint], limit[joint])
        axes.set_ylim(-height, height)
    _label_row(row, "velocity [rad/s]")


def _plot_torques(row: Any, demonstrations: Demonstrations, arm: Embodiment) -> None:
    assert demonstrations.torque is not None
    limit, maximum = np.asarray(arm.torque_limit), peak(demonstrations.torque)
    steps = np.repeat(demonstrations.torque, 2, axis=1)  # constant from each sample to the next
    time = np.repeat(_times(demonstrations), 2)[1:-1]
    for joint, axes in enumerate(row):
        _plot_lines(axes, time, steps[..., joint], "torque")
        _note(axes, maximum[joint], limit[joint])
        height = 1.4 * maximum[joint] or 1.0  # the limit is often ten times as large
        axes.set_ylim(-height, height)
        if limit[joint] <= height:
            _plot_limits(axes, (-limit[joint], limit[joint]))
    row[0].set_ylabel("torque [N m]")


def _plot_hand(figure: Any, paths: Float[np.ndarray, "demonstrations samples 3"]) -> None:
    flat = np.ptp(paths[..., 2]) < _FLAT
    views = [("from above", 0, 1)] if flat else [("from above", 0, 1), ("from the side", 0, 2)]
    for axes, (view, horizontal, vertical) in zip(
        figure.subplots(len(views), 1, squeeze=False).flat, views, strict=True
    ):
        _add_lines(axes, paths[..., horizontal], paths[..., vertical], "hand")
        axes.plot(paths[:, -1, horizontal], paths[:, -1, vertical], "o", color=_COLOURS["hand"], ms=2.5, label="end")
        axes.plot(*paths[0, 0, [horizontal, vertical]], "ks", ms=5, label="start")
        axes.set(xlabel="x [m]", ylabel=f"{'xyz'[vertical]} [m]", title=f"hand, {view}")
        axes.set_aspect("equal", adjustable="datalim")
        axes.locator_params(nbins=5)
        axes.grid(alpha=0.3)
    figure.legend(*figure.axes[0].get_legend_handles_labels(), loc="outside lower center", ncols=2)


def _times(demonstrations: Demonstrations) -> Float[np.ndarray, " samples"]:
    return demonstrations.dt * np.arange(demonstrations.horizon + 1)


def _opacity(lines: np.ndarray) -> float:
    """Opacity of each line: a few lines stay distinct, many lines show their density."""
    return float(np.clip(40 / len(lines), 0.35, 0.9))


def _plot_lines(axes: Any, time: np.ndarray, values: Float[np.ndarray, "demonstrations time"], quantity: str) -> None:
    _add_lines(axes, np.broadcast_to(time, values.shape), values, quantity)


def _add_lines(axes: Any, horizontal: np.ndarray, vertical: np.ndarray, quantity: str) -> None:
    """Draws thin lines [lines, points] as one artist: hundreds of artists take seconds."""
    style = {"color": _COLOURS[quantity], "lw": 0.6, "alpha": _opacity(vertical)}
    axes.add_collection(LineCollection(list(np.stack([horizontal, vertical], axis=-1)), **style))
    axes.autoscale_view()


def _plot_limits(axes: Any, limits: tuple[float, float]) -> None:
    for limit in limits:
        if np.isfinite(limit):
            axes.axhline(limit, **_LIMIT)


def _note(axes: Any, value: float, limit: float) -> None:
    """Writes the peak and its limit at the top of a panel."""
    note = f"peak {value:.2f}" + (f" of {limit:.4g}" if np.isfinite(limit) else "")
    axes.text(0.5, 0.97, note, transform=axes.transAxes, ha="center", va="top", fontsize="x-small")


def _label_row(row: Any, label: str) -> None:
    """Labels the scale, which all joints of a row share, at the first panel."""
    row[0].set_ylabel(label)
    for axes in row[1:]:
        axes.tick_params(labelleft=False)
