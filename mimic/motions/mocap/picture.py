"""The picture of a captured motion."""

from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt  # noqa: E402
import numpy as np  # noqa: E402

from mimic.motions.mocap.arms import find_arms  # noqa: E402
from mimic.motions.mocap.conventions import mean_point  # noqa: E402
from mimic.motions.mocap.points import PointMotion  # noqa: E402

_COLOURS = {"left": "tab:blue", "right": "tab:orange"}
_POSES = 5


def draw_skeleton(motion: PointMotion, path: Path, title: str) -> None:
    """Five poses of a body side by side, seen from the front and from the left, with its arms in colour.

    They are at times at which most points were seen.
    """
    seen = np.isfinite(motion.positions).all(axis=2).sum(axis=1)
    most = np.flatnonzero(seen == seen.max())
    samples = most[np.linspace(0, len(most) - 1, _POSES).round().astype(int)]
    figure, axes = plt.subplots(2, _POSES, figsize=(1.9 * _POSES, 7), sharey=True)
    arms = find_arms(motion)
    middle = np.nanmean(motion.positions[samples], axis=1, keepdims=True) * [1, 1, 0]
    centred = motion.positions[samples] - middle
    reach = 1.1 * float(np.nanmax(np.abs(centred[..., :2])))
    for column, sample in enumerate(samples):
        pose = centred[column]
        for row, (horizontal, label) in enumerate(((1, "y [m]"), (0, "x [m]"))):
            axis = axes[row, column]
            axis.plot(pose[:, horizontal], pose[:, 2], ".", color="0.6", markersize=3)
            for child, parent in enumerate(motion.parents):
                if parent >= 0:
                    axis.plot(pose[[parent, child], horizontal], pose[[parent, child], 2], color="0.6", linewidth=1)
            for side, arm in arms.items():
                groups = [group for group in (arm.shoulder, arm.elbow, arm.wrist, arm.hand) if group]
                line = np.stack([mean_point(motion, group)[sample] for group in groups])
                line -= middle[column]
                axis.plot(line[:, horizontal], line[:, 2], "o-", color=_COLOURS[side], markersize=3, label=side)
            axis.set_aspect("equal")
            axis.set_xlim(-reach, reach)
            axis.set_xlabel(label)
            if row == 0:
                axis.set_title(f"{sample / motion.rate:.1f} s", fontsize=9)
    axes[0, 0].set_ylabel("z [m]")
    axes[1, 0].set_ylabel("z [m]")
    if arms:
        axes[0, 0].legend(fontsize=8, loc="upper left")
    figure.suptitle(title)
    figure.tight_layout()
    figure.savefig(path, dpi=110)
    plt.close(figure)
