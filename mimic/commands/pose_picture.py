"""Picture of five poses of an expert, with the learner's nearest poses below them."""

import dataclasses
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import jax
import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt  # noqa: E402
import numpy as np  # noqa: E402
from jaxtyping import Float  # noqa: E402

from mimic.arms.arm import Arm, ArmConfig  # noqa: E402
from mimic.arms.rendering import ArmScene  # noqa: E402
from mimic.envs.config import EnvConfig
from mimic.metric.config import MetricConfig  # noqa: E402
from mimic.metric.similarity import CentreLine, centre_line_table, similarity  # noqa: E402
from mimic.retargeting.pose import imitate_pose  # noqa: E402

# Joint positions of the Panda [rad] that show the whole arm and are within its joint ranges.
PANDA_POSES = np.array(
    [
        [0.6, 0.7, -0.5, -1.3, 0.5, 1.6, 0.4],
        [-0.9, 0.5, 0.9, -1.8, -0.6, 1.2, 0.0],
        [0.3, -0.6, 0.4, -1.5, 1.2, 2.2, 0.8],
        [1.2, 0.5, 0.0, -1.3, 0.0, 1.7, 0.0],
        [-1.4, -0.3, 0.3, -2.3, 0.2, 2.0, -0.5],
    ],
    np.float32,
)
_EXPERT_COLOUR, _LEARNER_COLOUR = "tab:blue", "tab:orange"
_PIXELS = 260  # of one image; rendering meshes is slow without a GPU


@dataclasses.dataclass(frozen=True, eq=False)
class PosePairs:
    """Poses of an expert and the nearest poses of a learner.

    Attributes:
      expert_qpos: joint positions of the expert [rad].
      learner_qpos: joint positions of the learner with minimal embodiment distance [rad].
      distance: embodiment distance of each pair, at rest.
      similarity: measures of `mimic.metric.similarity`, each of shape [poses].
    """

    expert_qpos: Float[np.ndarray, "poses joints"]
    learner_qpos: Float[np.ndarray, "poses learner_joints"]
    distance: Float[np.ndarray, " poses"]
    similarity: Mapping[str, Float[np.ndarray, " poses"]]

    def as_json(self) -> list[dict[str, Any]]:
        """One entry for each pose."""
        columns = {
            "expert_qpos": self.expert_qpos,
            "learner_qpos": self.learner_qpos,
            "distance": self.distance,
            **self.similarity,
        }
        return [
            dict(zip(columns, row, strict=True)) for row in zip(*(x.tolist() for x in columns.values()), strict=True)
        ]


def readable_poses(
    config: ArmConfig, arm: Arm, candidates: Float[np.ndarray, "candidates joints"]
) -> Float[np.ndarray, "poses joints"]:
    """Returns five poses of an expert [rad]: fixed ones for the Panda, else evenly spaced ones from `candidates`."""
    if config.model == "panda":
        return PANDA_POSES[:, [int(name.removeprefix("joint")) - 1 for name in arm.embodiment.joint_names]]
    count = len(PANDA_POSES)
    return np.asarray(candidates, np.float32)[np.linspace(0, len(candidates) - 1, count + 1).round().astype(int)[1:]]


def nearest_poses(
    expert: Arm, learner: Arm, metric: MetricConfig, qpos: Float[np.ndarray, "poses joints"]
) -> PosePairs:
    """Computes the learner's poses with minimal embodiment distance to poses of the expert [rad], and similarity."""
    pair = expert.embodiment, learner.embodiment
    arguments = metric.build(*pair).arguments
    solution = jax.jit(lambda qpos: imitate_pose(*pair, qpos, **arguments))(qpos)
    learner_qpos = np.asarray(solution.qpos)
    measures = similarity(centre_line_table(pair[0], qpos), centre_line_table(pair[1], learner_qpos))
    return PosePairs(qpos, learner_qpos, np.asarray(solution.distance), measures)


def save_poses(path: Path, expert: Arm, learner: Arm, env: EnvConfig, pairs: PosePairs) -> None:
    """Draws each pose of the expert, the learner's pose over the expert's ghost, and both centre lines in one panel.

    Raises:
      ValueError: OpenGL is not available.
    """
    columns = len(pairs.expert_qpos)
    figure, rows = plt.subplots(3, columns, figsize=(2.2 * columns, 6.9), layout="constrained")
    lines: list[tuple[str, Any]] = []
    arms = (env.expert, expert, pairs.expert_qpos, "expert"), (env.learner, learner, pairs.learner_qpos, "learner")
    match = env.metric.match_links(expert.embodiment, learner.embodiment)
    colours = match.expert_colours, match.learner_colours
    for row, (config, arm, poses, role), arm_colours in zip(rows[:2], arms, colours, strict=True):
        with ArmScene([config], limits=env.limits, width=_PIXELS, height=_PIXELS, colours=[arm_colours]) as scene:
            scene.fit([poses])
            ghosts = map(match.ghost, pairs.expert_qpos, pairs.learner_qpos) if role == "learner" else [()] * columns
            images = [scene.image([pose], ghost) for pose, ghost in zip(poses, ghosts, strict=True)]
            show_images(row, images, f"{role}: {arm.embodiment.name}")
            lines.append((role, scene.flattened(_with_ends(centre_line_table(arm.embodiment, poses)))))
    for column, axes in enumerate(rows[2]):
        for (role, points), colour, width in zip(lines, (_EXPERT_COLOUR, _LEARNER_COLOUR), (6, 2.5), strict=True):
            alpha = 0.45 if role == "expert" else 1.0
            axes.plot(*points[column].T, color=colour, lw=width, alpha=alpha, label=role, solid_capstyle="round")
        axes.set(aspect="equal", xlim=(-0.6, 0.6), ylim=(-0.06, 0.9), xticks=[], yticks=[])
        axes.spines[:].set_visible(False)
        measures = {name: float(values[column]) for name, values in pairs.similarity.items()}
        axes.set_xlabel(
            f"centre line {measures['centre_line_distance']:.3f}\n"
            f"hand {measures['hand_position_error']:.3f}, {measures['hand_angle_deg']:.0f}°",
            fontsize="medium",
        )
    rows[2][0].set_ylabel("centre lines,\neach arm of length 1")
    rows[2][0].legend(fontsize="small", loc="upper left", frameon=False)
    figure.savefig(path, dpi=110)
    plt.close(figure)


def _with_ends(line: CentreLine) -> Float[np.ndarray, "poses points 3"]:
    """A centre line with its base and its hand [chain lengths]."""
    hand = line.hand_position[..., None, :]
    return np.concatenate([line.points[..., :1, :] * 0, line.points, hand], axis=-2)


def show_images(row: Sequence[Any], images: Sequence[np.ndarray], label: str) -> None:
    """Shows images in a row of axes, without ticks and frames, with a label at the first one."""
    for axes, image in zip(row, images, strict=True):
        axes.imshow(image)
        axes.set(xticks=[], yticks=[])
        axes.spines[:].set_visible(False)
    row[0].set_ylabel(label)
