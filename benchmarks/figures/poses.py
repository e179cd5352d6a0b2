"""Figures of the metric and of pose retargeting (static pose imitation in the paper), all computed here."""

import functools
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import matplotlib.ticker
import numpy as np
from matplotlib.lines import Line2D

from benchmarks.figures import candidate_points, similarity
from benchmarks.figures import metric as metric_figures
from benchmarks.figures.canvas import plt
from benchmarks.figures.planar_arms import add_match_legend, draw_match, fit, joint_points
from mimic.arms.embodiment import planar_arm
from mimic.arms.link_match import LinkMatch
from mimic.arms.rendering import ArmScene
from mimic.envs import env_config
from mimic.metric.config import MetricConfig
from mimic.metric.correspondence import hard_correspondence, overlap_correspondence
from mimic.metric.distance import DistanceWeights, adaptive_weights
from mimic.metric.landscape import distance_landscape, local_minima
from mimic.retargeting.pose import imitate_pose
from mimic.trainers.pose_mapper.mapper import PoseMapper

LoadMapper = Callable[[str], PoseMapper]  # from the name of an environment

_TWO_LINKS = planar_arm([0.5, 0.5])
_CONTOUR_POSE = np.array([1.5, -1.5])  # of the expert in Fig. 2 d-f of the paper
_WEIGHTS_POSE = np.array([2.3, -2.0])
_OTHER_TWO_LINKS = planar_arm([0.25, 0.75])  # identical arms would match for any weights
# Joint positions of the Panda [rad] that show the whole arm and are within its joint ranges.
_PANDA_POSES = np.array(
    [
        [0.6, 0.7, -0.5, -1.3, 0.5, 1.6, 0.4],
        [-0.9, 0.5, 0.9, -1.8, -0.6, 1.2, 0.0],
        [0.3, -0.6, 0.4, -1.5, 1.2, 2.2, 0.8],
    ],
    np.float32,
)
_PIXELS = 420
_OPTIMUM: dict[str, Any] = {"color": "black", "lw": 0.7, "marker": "o", "ms": 1.5}


def draw_weights(load_mapper: LoadMapper) -> Any:
    """Draws the nearest pose of an arm of other link lengths under three weights (paper, Fig. 2 a-c)."""
    del load_mapper
    figure, all_axes = plt.subplots(1, 3, figsize=(8, 2.9), layout="constrained")
    match = LinkMatch(_TWO_LINKS, _OTHER_TWO_LINKS, np.eye(2))  # as `hard_correspondence` pairs them
    for letter, axes, (translation, rotation) in zip("abc", all_axes, ((0.5, 1), (3, 1), (1, 1)), strict=True):
        weights = DistanceWeights(float(translation), float(rotation))
        solution = imitate_pose(_TWO_LINKS, _OTHER_TWO_LINKS, _WEIGHTS_POSE, hard_correspondence, weights)
        draw_match(axes, match, _WEIGHTS_POSE, solution.qpos)
        axes.set_xlabel(rf"({letter})  $\alpha_{{tr}}={translation}$, $\alpha_{{rot}}={rotation}$")
    fit(all_axes)
    add_match_legend(figure)
    return figure


def draw_contours(load_mapper: LoadMapper) -> Any:
    """Draws the distance over all poses of an identical two-link arm, with every local minimum.

    Panels d-f are those of Fig. 2 of the paper; panel g shows the default metric.
    """
    del load_mapper
    default = MetricConfig()
    metrics = (
        ("state-dependent W", hard_correspondence, DistanceWeights(1.5, 1.0)),
        ("state-dependent W, adaptive weights", hard_correspondence, adaptive_weights),
        ("static W, rotation only", overlap_correspondence(_TWO_LINKS, _TWO_LINKS), DistanceWeights(0.0, 1.0)),
        ("default metric", default.make_correspondence(_TWO_LINKS, _TWO_LINKS), default.make_weights()),
    )
    figure, all_axes = plt.subplots(1, 4, figsize=(13, 3.6), sharey=True, layout="constrained")
    for letter, axes, (name, correspondence, weights) in zip("defg", all_axes, metrics, strict=True):
        angles, distance = distance_landscape(_TWO_LINKS, _TWO_LINKS, _CONTOUR_POSE, correspondence, weights)
        filled = axes.contourf(angles, angles, distance.T, levels=24, cmap="viridis")
        axes.contour(angles, angles, distance.T, levels=24, colors="black", linewidths=0.2)
        minima = local_minima(distance)
        best = minima[np.argmin([distance[i, j] for i, j in minima])]
        axes.plot(angles[minima[:, 0]], angles[minima[:, 1]], "o", color="white", mec="black", ms=6)
        axes.plot(angles[best[0]], angles[best[1]], "*", color="red", mec="white", ms=13)
        count = f"{len(minima)} local minima" if len(minima) > 1 else "1 local minimum"
        axes.set_title(f"({letter})  {name}:\n{count}", fontsize="small")
        axes.set(xlabel=r"$\hat q_1$ [rad]", aspect="equal")
        figure.colorbar(filled, ax=axes, shrink=0.75, ticks=matplotlib.ticker.MaxNLocator(6))
    all_axes[0].set_ylabel(r"$\hat q_2$ [rad]")
    return figure


def draw_planar(load_mapper: LoadMapper) -> Any:
    """Draws the poses of trained pose mappers for unseen poses of planar arms (paper, Fig. 3)."""
    columns = 4
    figure, rows = plt.subplots(2, columns, figsize=(10, 5.8), layout="constrained")
    for name, row in zip(MAPPERS["planar"], rows, strict=True):
        mapper = load_mapper(name)
        expert, learner = mapper.expert, mapper.learner
        rng = np.random.default_rng(7)  # half the range trained on, so that arms overlap less
        poses = rng.uniform(-0.5 * np.pi, 0.5 * np.pi, (columns, expert.num_joints)).astype(np.float32)
        match = mapper.env.metric.match_links(expert, learner)
        mapped, optimal, excess = _mapped_and_optimal(mapper, poses)
        for axes, pose, learner_qpos, best, percent in zip(row, poses, mapped, optimal, excess, strict=True):
            draw_match(axes, match, pose, learner_qpos)
            axes.plot(*joint_points(learner, best).T, **_OPTIMUM)
            axes.set_xlabel(f"{percent:.2f} % above the optimum")
        row[0].set_ylabel(f"{expert.num_joints} to {learner.num_joints} joints")
    fit(rows.ravel())
    add_match_legend(figure, Line2D([], [], label="learner, optimum", **_OPTIMUM))
    return figure


def draw_panda(load_mapper: LoadMapper) -> Any:
    """Draws poses of trained pose mappers for unseen poses of the Panda, over its ghost (paper, Fig. 4).

    Locked joints are red.
    """
    names = MAPPERS["panda"]
    expert = env_config(names[0]).expert
    figure, rows = plt.subplots(len(names) + 1, len(_PANDA_POSES), figsize=(7.6, 10.2), layout="constrained")
    mappers = {name: load_mapper(name) for name in names}
    matches = {name: mapper.env.metric.match_links(mapper.expert, mapper.learner) for name, mapper in mappers.items()}
    colours = matches[names[0]].expert_colours
    with ArmScene([expert], width=_PIXELS, height=_PIXELS, colours=[colours]) as scene:
        scene.fit([_PANDA_POSES])
        _show_images(rows[0], [scene.image([pose]) for pose in _PANDA_POSES], "expert, 7 joints")
    for name, row in zip(names, rows[1:], strict=True):
        mapper = mappers[name]
        mapped, _, excess = _mapped_and_optimal(mapper, _PANDA_POSES)
        colours, learner = matches[name].learner_colours, env_config(name).learner
        with ArmScene([learner], width=_PIXELS, height=_PIXELS, colours=[colours]) as scene:
            scene.fit([mapped])
            pairs = zip(_PANDA_POSES, mapped, strict=True)
            images = [scene.image([pose], matches[name].ghost(expert_pose, pose)) for expert_pose, pose in pairs]
            _show_images(row, images, f"learner, {mapper.learner.num_joints} joints")
        for axes, percent in zip(row, excess, strict=True):
            axes.set_xlabel(f"{percent:.2f} % above the optimum", fontsize="small")
    return figure


def _show_images(row: Sequence[Any], images: Sequence[np.ndarray], label: str) -> None:
    """Shows images in a row of axes, without ticks and frames, with a label at the first one."""
    for axes, image in zip(row, images, strict=True):
        axes.imshow(image)
        axes.set(xticks=[], yticks=[])
        axes.spines[:].set_visible(False)
    row[0].set_ylabel(label)


FIGURES: dict[str, Callable[[LoadMapper], Any]] = {
    "links": lambda _: metric_figures.draw_links(),
    "correspondence": lambda _: metric_figures.draw_correspondence(),
    "similarity": lambda _: similarity.draw_similarity(),
    "points": lambda _: candidate_points.draw_points(),
    "weights": draw_weights,
    "contours": draw_contours,
    "planar": draw_planar,
    "panda": draw_panda,
}
MAPPERS = {  # environments whose pose mappers a figure needs
    "planar": ("planar4dof", "planar7dof"),
    "panda": ("panda7dof", "panda4dof", "panda3dof"),
}


def save_figure(name: str, out: Path, load_mapper: LoadMapper) -> list[Path]:
    """Draws a figure and writes it as PNG and as PDF."""
    figure = FIGURES[name](load_mapper)
    paths = [out / f"{name}.png", out / f"{name}.pdf"]
    for path in paths:
        figure.savefig(path, dpi=200, bbox_inches="tight")
    plt.close(figure)
    return paths


def _mapped_and_optimal(mapper: PoseMapper, poses: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Poses of the mapper and of the optimiser, and the mapper's excess distance [% of that of random poses]."""
    metric, expert, learner = mapper.env.metric, mapper.expert, mapper.learner
    mapped = np.asarray(mapper(poses))
    optimal = imitate_pose(expert, learner, poses, **metric.build(expert, learner).arguments)
    distance = functools.partial(_distances, mapper, poses)
    lower, upper = np.asarray(learner.joint_range).T
    random_poses = np.random.default_rng(0).uniform(lower, upper, (1000, learner.num_joints))
    random = np.array([_distances(mapper, np.repeat(pose[None], 1000, 0), random_poses).mean() for pose in poses])
    best = distance(optimal.qpos)
    return mapped, np.asarray(optimal.qpos), 100 * (distance(mapped) - best) / (random - best)


def _distances(mapper: PoseMapper, poses: np.ndarray, learner_poses: Any) -> np.ndarray:
    return np.asarray(jax.jit(jax.vmap(mapper.distance))(poses, jnp.asarray(learner_poses, jnp.float32)))
