"""`trainer=pose_mapper`: a network that maps poses of the expert to the learner's nearest poses."""

import functools
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from mimic.kinematics import link_states
from mimic.pose import imitate_pose
from mimic.trainers import mapper_training
from mimic.trainers.config import PoseMapperConfig, TrainConfig
from mimic.trainers.job import Figures, Job, OnEvaluation, Params, Row
from mimic.trainers.pose_mapper import make_model
from mimic.trainers.signals import Signals

# Keys of the poses. A run's seed changes the network and what it trains on; what it is judged on stays the same.
_TRAINING, _VALIDATION, _HELD_OUT, _CHANCE = range(4)


class _Reference(NamedTuple):
    """What the poses allow, by split: the optimiser's poses and distances, and the mean distance of random poses."""

    qpos: dict[str, np.ndarray]
    distance: dict[str, np.ndarray]
    random: dict[str, float]


class MapperJob(Job):
    """Trains a mapper; tells how near to the optimum it gets on training poses and on unseen ones.

    Args:
      config: of the run.
      run_dir: not needed: the poses follow from the seed.

    Raises:
      ValueError: settings or arms that cannot be used.
    """

    unit = "training_poses"

    def __init__(self, config: TrainConfig, run_dir: Path | None = None):
        del run_dir
        assert isinstance(config.trainer, PoseMapperConfig)
        self.settings: PoseMapperConfig = config.trainer.resolve()
        self._name, self._seed = config.env.name, config.seed
        self.total_steps = self.settings.total_steps
        self._model = model = make_model(config.env, self.settings)
        samples = int(self.settings.samples or 0)
        seen = mapper_training.random_poses(model, jax.random.fold_in(_key(_TRAINING), config.seed), samples)
        self._seen = seen
        self._poses = {
            "train": seen[: self.settings.validation_poses],
            "validation": mapper_training.random_poses(model, _key(_VALIDATION), self.settings.validation_poses),
            "held_out": mapper_training.random_poses(model, _key(_HELD_OUT), self.settings.held_out_poses),
        }
        kind = "fresh poses in each epoch" if self.settings.fresh else "training poses"
        self.headline = f"{config.env.name}: {model.expert.name} to {model.learner.name}, {samples} {kind}"
        self._program = jax.jit(lambda params, poses: jax.vmap(functools.partial(model, params))(poses))
        self._distance = jax.jit(jax.vmap(model.distance))
        self._directions = jax.jit(
            lambda qpos, learner_qpos: (
                jax.vmap(lambda q: link_states(model.expert, q).direction)(qpos),
                jax.vmap(lambda q: link_states(model.learner, q).direction)(learner_qpos),
            )
        )

    @functools.cached_property
    def _reference(self) -> _Reference:
        """Computed when it is first asked for."""
        model, metric = self._model, self._model.metric
        correspondence = metric.make_correspondence(model.expert, model.learner)
        every = jnp.concatenate(list(self._poses.values()))
        found = imitate_pose(
            model.expert,
            model.learner,
            every,
            correspondence,
            metric.make_weights(),
            rotation=metric.rotation_measure,  # type: ignore[arg-type]
            reduction=metric.reduction,  # type: ignore[arg-type]
        )
        lower, upper = jnp.asarray(model.learner.joint_range, jnp.float32).T
        chance = jax.random.uniform(_key(_CHANCE), (len(every), len(lower)), minval=lower, maxval=upper)
        ends = np.cumsum([len(poses) for poses in self._poses.values()])[:-1]
        by_split = [
            dict(zip(self._poses, np.split(np.asarray(values), ends), strict=True))
            for values in (found.qpos, found.distance, self._distance(every, chance))
        ]
        return _Reference(by_split[0], by_split[1], {split: float(x.mean()) for split, x in by_split[2].items()})

    def save_inputs(self, run_dir: Path) -> None:
        """Nothing: the poses follow from the seed."""

    def params_template(self) -> Params:
        """Of the network."""
        return jax.eval_shape(self._model.init, jax.random.key(0))

    def train(
        self, run_dir: Path, on_evaluation: OnEvaluation, signals: Signals, restore: tuple[int, Params] | None
    ) -> tuple[int, Params]:
        """Through the metric, see `mapper_training`."""
        return mapper_training.train(
            self._model,
            self._seen,
            self._poses["validation"],
            run_dir,
            seed=self._seed,
            on_evaluation=on_evaluation,
            signals=signals,
            restore=restore,
        )

    def evaluate(self, params: Params) -> dict[str, np.ndarray]:
        """The learner's poses, by split."""
        return {split: np.asarray(self._program(params, poses)) for split, poses in self._poses.items()}

    def figures(self, outcome: dict[str, np.ndarray]) -> Figures:
        """Quality and what it is made of, by split; angles on held-out poses."""
        reference = self._reference
        mean = {split: float(self._distance(poses, outcome[split]).mean()) for split, poses in self._poses.items()}
        optimum = {split: float(distance.mean()) for split, distance in reference.distance.items()}
        random = reference.random
        quality = {split: (mean[split] - optimum[split]) / (random[split] - optimum[split]) for split in mean}
        to_expert, to_optimum = self._angles(outcome["held_out"])
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

    def _angles(self, found: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Median angles [deg] of each link on held-out poses: to the expert's corresponding links, to the optimum."""
        expert, learner = map(np.asarray, self._directions(self._poses["held_out"], found))
        optimum = np.asarray(self._directions(self._poses["held_out"], self._reference.qpos["held_out"])[1])
        model = self._model
        shares = model.metric.shares(model.expert, model.learner)
        to_expert = np.einsum("ij,pij->pj", shares, _angle(expert[:, :, None], learner[:, None]))
        return np.median(to_expert, axis=0), np.median(_angle(learner, optimum), axis=0)

    def status(self, figures: Figures) -> str:
        """Distance and quality."""
        quality, distance = figures["quality"], figures["mean_distance"]["validation"]
        return f"distance {distance:.4f}  above the optimum {quality['train']:.2%}, unseen {quality['validation']:.2%}"

    def good_enough(self, figures: Figures) -> bool:
        """At the target quality on validation poses."""
        return figures["quality"]["validation"] <= self.settings.target_quality

    def rows(self, figures: Figures) -> list[Row]:
        """Quality and what it is made of."""
        by_split: tuple[tuple[str, str, str], ...] = (
            ("above the optimum (0 best, 1 a random pose)", "quality", "{:.2%}"),
            ("mean distance", "mean_distance", "{:.4f}"),
            ("  optimal poses", "optimal_distance", "{:.4f}"),
            ("  random poses", "random_distance", "{:.4f}"),
        )
        rows = [
            (label, form.format(figures[key]["train"]), form.format(figures[key]["held_out"]))
            for label, key, form in by_split
        ]
        to_optimum = max(figures["link_angle_to_optimum_deg_by_link"].values())
        return [
            *rows,
            ("median angle to the expert's links", "", f"{figures['link_angle_error_deg']:.1f} deg"),
            ("median angle to the optimum, worst link", "", f"{to_optimum:.1f} deg"),
        ]

    def save_outcome(self, folder: Path, outcome: Any, controller: str = "policy") -> None:
        """In a run directory, how it learned."""
        del outcome, controller
        from mimic.trainers import plots  # matplotlib, a second; not before there is something to plot

        plots.plot_training(folder, "quality", "above the optimum [%]", of="poses", title=self._name)


def _key(purpose: int) -> jax.Array:
    return jax.random.fold_in(jax.random.key(0), purpose)


def _angle(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Degrees between unit vectors along the last axis."""
    return np.degrees(np.arccos(np.clip((a * b).sum(axis=-1), -1, 1)))
