"""`trainer=pose_mapper`: trains a network that maps poses of the expert to the nearest poses of the learner."""

import functools
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import jax
import numpy as np
from jaxtyping import Array, Float

from mimic.base.compilation import Background, compiling
from mimic.evaluation.rollout_metrics import pose_similarity
from mimic.retargeting.pose_baselines import copy_joints
from mimic.runs.checkpoints import Checkpoint
from mimic.runs.signals import Signals
from mimic.trainers.config import PoseMapperConfig, TrainConfig
from mimic.trainers.pose_mapper import training
from mimic.trainers.pose_mapper.evaluation import Mapped, Reference, make_reference, mean_distances, run_mapper
from mimic.trainers.pose_mapper.model import make_model, random_poses
from mimic.trainers.trainer import Metrics, OnEvaluation, Params, Row, Trainer

# Numbers of the random keys. A run's seed changes the network and the training; the evaluation is the same in all runs.
_TRAINING, _VALIDATION, _HELD_OUT, _OTHER_POSES = range(4)
_SIMILARITY_POSES = 500  # inverse kinematics takes a millisecond for each


class PoseMapperTrainer(Trainer):
    """Trains a mapper, and compares it with the optimum: on training poses, those that end it early, and held-out ones.

    Args:
      config: the run's config.
      run_dir: unused, because the poses follow from the config and the seed.

    Raises:
      ValueError: settings, a metric or arms that cannot be used.
    """

    unit = "training_poses"

    def __init__(self, config: TrainConfig, run_dir: Path | None = None):
        del run_dir
        assert isinstance(config.trainer, PoseMapperConfig)
        self.settings: PoseMapperConfig = config.trainer
        self._name, self._seed = config.env.name, config.seed % 2**31  # the range of a 32-bit integer
        self.total_steps = self.settings.total_steps
        self.env_config = config.env
        self.model = make_model(config.env, self.settings)
        kind = "fresh poses in each epoch" if self.settings.fresh else "training poses"
        arms = f"{self.model.expert.name} to {self.model.learner.name}"
        self.headline = f"{config.env.name}: {arms}, {self.settings.samples} {kind}"
        few = min(self.settings.validation_poses, self.settings.samples)
        end = few + self.settings.validation_poses
        self._splits = {"train": slice(few), "validation": slice(few, end), "held_out": slice(end, None)}

    @functools.cached_property
    def samples(self) -> Mapping[str, Any]:
        """Poses of the training, those of all epochs unless each has fresh ones, and of the validation [rad]."""
        return jax.jit(self._draw_samples)(self._seed)

    def _draw_samples(self, seed: int) -> Mapping[str, Any]:
        draw, settings = functools.partial(random_poses, self.model.expert), self.settings
        return {
            "train": draw(jax.random.fold_in(_key(_TRAINING), seed), settings.samples),
            "validation": draw(_key(_VALIDATION), settings.validation_poses),
        }

    @functools.cached_property
    def poses(self) -> Float[np.ndarray, "poses joints"]:
        """The expert's poses of the report [rad], one split after the other."""
        held_out = random_poses(self.model.expert, _key(_HELD_OUT), self.settings.held_out_poses)
        return np.concatenate([self.samples["train"][self._splits["train"]], self.samples["validation"], held_out])

    @functools.cached_property
    def _evaluation(self) -> Background[Callable[..., Mapped]]:
        return compiling(functools.partial(run_mapper, self.model), self.params_template(), self.poses)

    @functools.cached_property
    def _optimisation(self) -> Background[Callable[..., Reference]]:
        return compiling(lambda poses: make_reference(self.model, _key(_OTHER_POSES), poses), self.poses)

    @functools.cached_property
    def _reference(self) -> Reference:
        return jax.device_get(self._optimisation()(self.poses))

    def params_template(self) -> Params:
        """Shapes of the network's parameters."""
        return jax.eval_shape(lambda: self.model.init(jax.random.key(0)))

    def policy(self, params: Params) -> Callable[[Any], Any]:
        """The mapper: pose of the expert -> pose of the learner [rad]."""
        return jax.jit(lambda qpos: self.model(params, qpos))

    def train(
        self, run_dir: Path, on_evaluation: OnEvaluation, signals: Signals, restored: Checkpoint | None
    ) -> tuple[int, Params]:
        """Trains with the metric as loss, see `mimic.trainers.pose_mapper.training.train`."""
        # Starts to compile these in parallel with the training's functions, the slowest first.
        _ = self._optimisation, self._evaluation
        return training.train(
            self.model,
            lambda: (self.samples["train"], self.samples["validation"]),
            run_dir,
            seed=self._seed,
            on_evaluation=on_evaluation,
            signals=signals,
            restored=restored,
        )

    def evaluate(self, params: Params) -> Mapped:
        """The learner's poses for the poses of the report."""
        _ = self._optimisation  # starts to compile it in parallel with the evaluation, if there was no training
        return jax.device_get(self._evaluation()(params, self.poses))

    def metrics(self, outcome: Mapped) -> Metrics:
        """Quality and the distances that define it by split, see `mean_distances`, and angles on held-out poses."""
        tables = {split: mean_distances(self._reference, outcome, part) for split, part in self._splits.items()}
        means = {name: {split: table[name] for split, table in tables.items()} for name in tables["train"]}
        return means | self._angles(outcome)

    def _angles(self, mapped: Mapped) -> Metrics:
        """Median angles [deg] of each link on held-out poses: to the expert's corresponding links, to the optimum."""
        reference, model = self._reference, self.model
        directions = reference.expert_direction, mapped.direction, reference.direction
        expert, learner, optimum = (direction[self._splits["held_out"]] for direction in directions)
        fractions = self.env_config.metric.link_fractions(model.expert, model.learner)
        angles = np.einsum("ij,pij->pj", fractions, _angle(expert[:, :, None], learner[:, None]))
        to_expert, to_optimum = np.median(angles, axis=0), np.median(_angle(learner, optimum), axis=0)
        names = model.learner.link_names
        return {
            "link_angle_error_deg": float(to_expert.mean()),
            "link_angle_error_deg_by_link": dict(zip(names, map(float, to_expert), strict=True)),
            "link_angle_to_optimum_deg_by_link": dict(zip(names, map(float, to_optimum), strict=True)),
        }

    def details(self, outcome: Mapped, controller: str = "mapper") -> Metrics:
        """Similarity of some held-out poses of the mapper, the optimum and the baselines to the expert's."""
        first = self._splits["held_out"].start
        expert_qpos, mapped_qpos, optimal_qpos = (
            np.asarray(qpos)[first : first + _SIMILARITY_POSES, None]
            for qpos in (self.poses, outcome.qpos, self._reference.qpos)
        )  # motions of one sample
        poses = {"mapper": mapped_qpos, "nearest_poses": optimal_qpos}
        similarity = pose_similarity(self.model.expert, self.model.learner, expert_qpos, poses, split="held_out")
        return {"similarity": similarity}

    def copying_distance(self) -> dict[str, float] | None:
        """Mean distance by split of copying the angles of joints with the same name; None without any such joint."""
        copied = copy_joints(self.model.expert, self.model.learner, self.poses)
        if copied is None:
            return None
        distances = np.asarray(jax.jit(jax.vmap(self.model.distance))(self.poses, copied))
        return {split: float(distances[part].mean()) for split, part in self._splits.items()}

    def status(self, metrics: Metrics) -> str:
        """Distance and quality."""
        quality, distance = metrics["quality"], metrics["mean_distance"]["validation"]
        unseen = quality["validation"]
        return f"distance {distance:.4f}  above the optimum {quality['train']:.2%}, unseen {unseen:.2%}"

    def rows(self, metrics: Metrics) -> list[Row]:
        """Rows of the quality, of the distances that define it, and of the angles between links."""
        rows = (
            ("above the optimum (0 best, 1 a random pose)", "quality", "{:.2%}"),
            ("mean distance", "mean_distance", "{:.4f}"),
            ("  optimal poses", "optimal_distance", "{:.4f}"),
            ("  random poses", "random_distance", "{:.4f}"),
        )
        to_optimum = max(metrics["link_angle_to_optimum_deg_by_link"].values())
        return [
            *(
                (name, form.format(metrics[key]["train"]), form.format(metrics[key]["held_out"]))
                for name, key, form in rows
            ),
            ("median angle to the expert's links", "", f"{metrics['link_angle_error_deg']:.1f} deg"),
            ("median angle to the optimum, worst link", "", f"{to_optimum:.1f} deg"),
        ]

    def save_outcome(self, folder: Path, outcome: Any, controller: str = "policy") -> None:
        """Writes in a run directory a plot of the training."""
        del outcome, controller
        from mimic.evaluation import plots  # imports matplotlib, which takes a second

        label, labels = "above the optimum [%]", plots.labels_of("poses")
        plots.plot_training(folder, "quality", label, labels=labels, title=self._name)


def _key(purpose: int) -> Array:
    """A random key that depends on its purpose alone."""
    return jax.random.fold_in(jax.random.key(0), purpose)


def _angle(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Angles [deg] between unit vectors along the last axis."""
    return np.degrees(np.arccos(np.clip((a * b).sum(axis=-1), -1, 1)))
