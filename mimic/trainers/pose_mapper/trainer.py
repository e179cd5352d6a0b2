"""`trainer=pose_mapper`: trains a network that maps poses of the expert to the nearest poses of the learner."""

import functools
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from mimic.base.compilation import Background, compiling
from mimic.evaluation.rollout_metrics import pose_similarity
from mimic.metric.kinematics import link_states
from mimic.retargeting.pose import imitate_pose
from mimic.retargeting.pose_baselines import copy_joints
from mimic.runs.checkpoints import Checkpoint
from mimic.runs.signals import Signals
from mimic.trainers.config import PoseMapperConfig, TrainConfig
from mimic.trainers.pose_mapper import training
from mimic.trainers.pose_mapper.model import make_model
from mimic.trainers.trainer import Metrics, OnEvaluation, Params, Row, Trainer

# Numbers of the random keys of the poses. A run's seed changes the network and the training poses; the poses of the
# evaluation are the same in all runs.
_TRAINING, _VALIDATION, _HELD_OUT, _RANDOM = range(4)
_SIMILARITY_POSES = 500  # held-out poses for the similarity: inverse kinematics takes a millisecond each


class _Evaluated(NamedTuple):
    """The learner's poses for all evaluation poses, and their metrics.

    Attributes:
      qpos: [poses, learner_joints] [rad].
      distance: [poses] embodiment distance to the expert's poses.
      direction: [poses, links, 3] directions of the learner's links.
    """

    qpos: Any
    distance: Any
    direction: Any


class _Reference(NamedTuple):
    """What the mapper is compared with.

    Attributes:
      optimum: the optimiser's poses.
      random_distance: [poses] embodiment distance of random poses.
      expert_direction: [poses, links, 3] directions of the expert's links.
    """

    optimum: _Evaluated
    random_distance: Any
    expert_direction: Any


class PoseMapperTrainer(Trainer):
    """Trains a mapper, and compares it with the optimum on training poses and on held-out poses.

    Args:
      config: the run's config.
      run_dir: unused, because the poses follow from the seed.

    Raises:
      ValueError: settings or arms that cannot be used.
    """

    unit = "training_poses"

    def __init__(self, config: TrainConfig, run_dir: Path | None = None):
        del run_dir
        assert isinstance(config.trainer, PoseMapperConfig)
        self.settings: PoseMapperConfig = config.trainer
        self._name, self._seed = config.env.name, config.seed % 2**31  # the range of a 32-bit integer
        self.total_steps = self.settings.total_steps
        self.env_config = config.env
        self._model = model = make_model(config.env, self.settings)
        kind = "fresh poses in each epoch" if self.settings.fresh else "training poses"
        self.headline = (
            f"{config.env.name}: {model.expert.name} to {model.learner.name}, {self.settings.samples} {kind}"
        )

    @functools.cached_property
    def _poses(self) -> dict[str, Array]:
        """The poses of each split. The training poses are those of all epochs, unless each epoch has fresh ones."""
        return jax.jit(self._draw)(self._seed)

    def _draw(self, seed: int) -> dict[str, Array]:
        settings, draw = self.settings, functools.partial(training.random_poses, self._model)
        return {
            "train": draw(jax.random.fold_in(_key(_TRAINING), seed), settings.samples),
            "validation": draw(_key(_VALIDATION), settings.validation_poses),
            "held_out": draw(_key(_HELD_OUT), settings.held_out_poses),
        }

    @property
    def _counts(self) -> dict[str, int]:
        """Number of evaluation poses of each split."""
        few, many = self.settings.validation_poses, self.settings.held_out_poses
        return {"train": min(few, self.settings.samples), "validation": few, "held_out": many}

    @property
    def _poses_shape(self) -> jax.ShapeDtypeStruct:
        return training.poses_shape(self._model, sum(self._counts.values()))

    @functools.cached_property
    def _evaluation_poses(self) -> np.ndarray:
        """The evaluation poses of all splits."""
        return np.concatenate([self._poses[split][:count] for split, count in self._counts.items()])

    def _by_split(self, values: np.ndarray) -> dict[str, np.ndarray]:
        ends = np.cumsum(list(self._counts.values()))[:-1]
        return dict(zip(self._counts, np.split(values, ends), strict=True))

    def _evaluated(self, expert_qpos: Array, qpos: Array) -> _Evaluated:
        direction = jax.vmap(lambda q: link_states(self._model.learner, q).direction)(qpos)
        return _Evaluated(qpos, jax.vmap(self._model.distance)(expert_qpos, qpos), direction)

    @functools.cached_property
    def _evaluation(self) -> Background[Callable[[Params, np.ndarray], _Evaluated]]:
        def evaluated(params: Params, poses: Array) -> _Evaluated:
            return self._evaluated(poses, jax.vmap(functools.partial(self._model, params))(poses))

        return compiling(evaluated, self.params_template(), self._poses_shape)

    @functools.cached_property
    def _optimisation(self) -> Background[Callable[[np.ndarray], _Reference]]:
        model = self._model

        def reference(poses: Array) -> _Reference:
            kept = None  # halves the time to compile
            solution = imitate_pose(model.expert, model.learner, poses, kept=kept, **model.built_metric.arguments)
            lower, upper = jnp.asarray(model.learner.joint_range, jnp.float32).T
            random = jax.random.uniform(_key(_RANDOM), (len(poses), len(lower)), minval=lower, maxval=upper)
            direction = jax.vmap(lambda q: link_states(model.expert, q).direction)(poses)
            random_distance = jax.vmap(model.distance)(poses, random)
            return _Reference(self._evaluated(poses, solution.qpos), random_distance, direction)

        return compiling(reference, self._poses_shape)

    @functools.cached_property
    def _reference(self) -> _Reference:
        return jax.device_get(self._optimisation()(self._evaluation_poses))

    def params_template(self) -> Params:
        """Shapes of the network's parameters."""
        return jax.eval_shape(lambda: self._model.init(jax.random.key(0)))

    def policy(self, params: Params) -> Callable[[Any], Any]:
        """The mapper: pose of the expert -> pose of the learner [rad]."""
        return jax.jit(lambda qpos: self._model(params, qpos))

    def train(
        self, run_dir: Path, on_evaluation: OnEvaluation, signals: Signals, restored: Checkpoint | None
    ) -> tuple[int, Params]:
        """Trains with the metric as loss, see `mimic.trainers.pose_mapper.training.train`."""
        # Starts to compile these in parallel with the training's functions, the slowest first.
        _ = self._optimisation, self._evaluation
        return training.train(
            training.mapper_objective(self._model),
            self.settings,
            lambda: (self._poses["train"], self._poses["validation"]),
            run_dir,
            seed=self._seed,
            on_evaluation=on_evaluation,
            signals=signals,
            restored=restored,
        )

    def evaluate(self, params: Params) -> _Evaluated:
        """The learner's poses for the evaluation poses, and their distances."""
        _ = self._optimisation  # starts to compile it in parallel with the evaluation, if there was no training
        return jax.device_get(self._evaluation()(params, self._evaluation_poses))

    def metrics(self, outcome: _Evaluated) -> Metrics:
        """Quality and the distances that define it, by split; angles on held-out poses."""
        reference = self._reference

        def means(distance: np.ndarray) -> dict[str, float]:
            return {split: float(values.mean()) for split, values in self._by_split(distance).items()}

        mean, optimum = means(outcome.distance), means(reference.optimum.distance)
        random = means(reference.random_distance)
        quality = {split: (mean[split] - optimum[split]) / (random[split] - optimum[split]) for split in mean}
        to_expert, to_optimum = self._angles(outcome)
        names = self._model.learner.link_names
        return {
            "quality": quality,
            "mean_distance": mean,
            "optimal_distance": optimum,
            "random_distance": random,
            "link_angle_error_deg": float(to_expert.mean()),
            "link_angle_error_deg_by_link": dict(zip(names, map(float, to_expert), strict=True)),
            "link_angle_to_optimum_deg_by_link": dict(zip(names, map(float, to_optimum), strict=True)),
        }

    def _angles(self, outcome: _Evaluated) -> tuple[np.ndarray, np.ndarray]:
        """Median angles [deg] of each link on held-out poses: to the expert's corresponding links, to the optimum."""
        reference, model = self._reference, self._model
        directions = reference.expert_direction, outcome.direction, reference.optimum.direction
        expert, learner, optimum = (self._by_split(direction)["held_out"] for direction in directions)
        to_expert = np.einsum(
            "ij,pij->pj",
            model.metric.link_fractions(model.expert, model.learner),
            _angle(expert[:, :, None], learner[:, None]),
        )
        return np.median(to_expert, axis=0), np.median(_angle(learner, optimum), axis=0)

    def details(self, outcome: _Evaluated, controller: str = "mapper") -> Metrics:
        """Similarity of the first held-out poses, for the mapper, the optimiser and the baselines."""
        model, count = self._model, min(_SIMILARITY_POSES, self.settings.held_out_poses)
        expert, mapped, optimum = (
            self._by_split(np.asarray(qpos))["held_out"][:count, None]  # motions of one sample
            for qpos in (self._evaluation_poses, outcome.qpos, self._reference.optimum.qpos)
        )
        poses = {"mapper": mapped, "nearest_poses": optimum}
        return {"similarity": pose_similarity(model.expert, model.learner, expert, poses, split="held_out")}

    def copying_distance(self) -> dict[str, float] | None:
        """Mean distance by split of copying the angles of joints with the same name; None without any such joint."""
        model, poses = self._model, self._evaluation_poses
        copied = copy_joints(model.expert, model.learner, poses)
        if copied is None:
            return None
        distance = np.asarray(jax.jit(jax.vmap(model.distance))(poses, copied))
        return {split: float(values.mean()) for split, values in self._by_split(distance).items()}

    def status(self, metrics: Metrics) -> str:
        """Distance and quality."""
        quality, distance = metrics["quality"], metrics["mean_distance"]["validation"]
        return f"distance {distance:.4f}  above the optimum {quality['train']:.2%}, unseen {quality['validation']:.2%}"

    def good_enough(self, metrics: Metrics) -> bool:
        """Whether the target quality is reached on the validation poses."""
        return metrics["quality"]["validation"] <= self.settings.target_quality

    def rows(self, metrics: Metrics) -> list[Row]:
        """Rows of the quality, the distances that define it, and the angles."""
        by_split: tuple[tuple[str, str, str], ...] = (
            ("above the optimum (0 best, 1 a random pose)", "quality", "{:.2%}"),
            ("mean distance", "mean_distance", "{:.4f}"),
            ("  optimal poses", "optimal_distance", "{:.4f}"),
            ("  random poses", "random_distance", "{:.4f}"),
        )
        rows = [
            (label, form.format(metrics[key]["train"]), form.format(metrics[key]["held_out"]))
            for label, key, form in by_split
        ]
        to_optimum = max(metrics["link_angle_to_optimum_deg_by_link"].values())
        return [
            *rows,
            ("median angle to the expert's links", "", f"{metrics['link_angle_error_deg']:.1f} deg"),
            ("median angle to the optimum, worst link", "", f"{to_optimum:.1f} deg"),
        ]

    def save_outcome(self, folder: Path, outcome: Any, controller: str = "policy") -> None:
        """Writes a plot of the training, in a run directory."""
        del outcome, controller
        from mimic.evaluation import plots  # imports matplotlib, which takes a second

        labels = plots.labels_of("poses")
        plots.plot_training(folder, "quality", "above the optimum [%]", labels=labels, title=self._name)


def _key(purpose: int) -> jax.Array:
    return jax.random.fold_in(jax.random.key(0), purpose)


def _angle(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Angles [deg] between unit vectors along the last axis."""
    return np.degrees(np.arccos(np.clip((a * b).sum(axis=-1), -1, 1)))
