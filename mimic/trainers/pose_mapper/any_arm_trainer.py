"""`trainer=pose_mapper` where the environment draws its learner: trains one mapper to any arm."""

import csv
import functools
import io
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import jax
import numpy as np
from jaxtyping import Array

from mimic.any_arm.arrays import ArmArrays, stack_arms
from mimic.any_arm.family import SEEN, UNSEEN, arm_sampler, report_arms
from mimic.compilation import Background, compiling
from mimic.runs.checkpoints import Checkpoint
from mimic.runs.files import write_atomically
from mimic.runs.signals import Signals
from mimic.trainers.config import AnyArmMapperSettings, PoseMapperConfig, TrainConfig
from mimic.trainers.pose_mapper import training
from mimic.trainers.pose_mapper.any_arm_evaluation import (
    METHODS,
    Mapped,
    Reference,
    best_poses,
    make_reference,
    mean_similarity,
    run_mapper,
    table_of_arms,
)
from mimic.trainers.pose_mapper.any_arm_model import make_any_arm_model
from mimic.trainers.pose_mapper.any_arm_training import any_arm_objective, random_pose
from mimic.trainers.trainer import Metrics, OnEvaluation, Params, Row, Trainer

# Numbers of the random keys. A run's seed changes the network and the training; the evaluation is the same in all runs.
_TRAINING, _VALIDATION, _HELD_OUT, _GUESSES, _ARMS = range(5)
_SEED = 2**20  # of these: a small one would be that of a training too
_SPLITS = {"train": SEEN, "held_out": UNSEEN}  # the columns of a report: arms seen in training, and others
_SIMILARITY_POSES = 32  # of each arm
_DRAWN_ARMS = 16  # of the report, where the config names none that training sees


class AnyArmMapperTrainer(Trainer):
    """Trains a mapper to any arm, and compares it with the optimum on arms that it has seen and on others.

    Both columns of the report are on the same poses of the expert, which are in no training.

    Args:
      config: the run's config.
      run_dir: unused, because arms and poses follow from the config and the seed.

    Raises:
      ValueError: settings, a metric or arms that cannot be used.
    """

    unit = "training_poses"
    columns = ("seen arms", "unseen arms")

    def __init__(self, config: TrainConfig, run_dir: Path | None = None):
        del run_dir
        assert isinstance(config.trainer, PoseMapperConfig)
        self.settings: AnyArmMapperSettings = config.trainer.resolve_any_arm(jax.default_backend())
        self._name, self._seed = config.env.name, config.seed % 2**31  # the range of a 32-bit integer
        self.total_steps = self.settings.total_steps
        self.env_config = config.env
        self._model = make_any_arm_model(config.env, self.settings)
        sampler = arm_sampler(config.env)
        self._objective = any_arm_objective(self._model, sampler)
        self._arms = _arms_by_split(report_arms(config.env), sampler)
        counts = " and ".join(f"{len(self._arms[split])} {name}" for split, name in _SPLITS.items())
        kind = "fresh arms and poses in each epoch" if self.settings.fresh else "training arms and poses"
        self.headline = (
            f"{config.env.name}: {config.env.expert.model} to any arm, {self.settings.samples} {kind}, "
            f"report on {counts} arms"
        )

    @functools.cached_property
    def _stacked_arms(self) -> ArmArrays:
        arms = [arm.astype(np.float32) for of_split in self._arms.values() for arm in of_split.values()]
        return stack_arms(arms)

    @functools.cached_property
    def _expert_qpos(self) -> np.ndarray:
        """The expert's poses [poses, joints] of the evaluation [rad]."""
        keys = jax.random.split(_key(_HELD_OUT), self.settings.held_out_poses)
        return np.asarray(jax.jit(jax.vmap(lambda key: random_pose(self._model.expert, key)))(keys))

    @functools.cached_property
    def _inputs(self) -> tuple[ArmArrays, np.ndarray]:
        return self._stacked_arms, self._expert_qpos

    @functools.cached_property
    def _evaluation(self) -> Background[Callable[..., Mapped]]:
        return compiling(functools.partial(run_mapper, self._model), self.params_template(), *self._inputs)

    @functools.cached_property
    def _optimisation(self) -> Background[Callable[..., Reference]]:
        return compiling(functools.partial(make_reference, self._model), _key(_GUESSES), *self._inputs)

    @functools.cached_property
    def _reference(self) -> Reference:
        return jax.device_get(self._optimisation()(_key(_GUESSES), *self._inputs))

    def save_inputs(self, run_dir: Path) -> None:
        """Writes nothing, because arms and poses follow from the config and the seed."""

    def params_template(self) -> Params:
        """Shapes of the network's parameters."""
        return jax.eval_shape(lambda: self._model.init(jax.random.key(0)))

    def policy(self, params: Params) -> Callable[[Any], Any]:
        """Raises a ValueError: this mapper is a function of a learner too."""
        del params
        raise ValueError("policy: a mapper to any arm needs a learner; load it with mimic.AnyArmMapper.load(RUN_DIR)")

    def train(
        self, run_dir: Path, on_evaluation: OnEvaluation, signals: Signals, restored: Checkpoint | None
    ) -> tuple[int, Params]:
        """Trains with the metric as loss, see `mimic.trainers.pose_mapper.training.train`."""
        _ = self._optimisation, self._evaluation  # start to compile in parallel with the training's functions
        samples, validation = self.settings.samples, self.settings.validation_poses
        draw = self._objective.draw
        return training.train(
            self._objective,
            self.settings,
            lambda: (
                draw(jax.random.fold_in(_key(_TRAINING), self._seed), samples),
                draw(_key(_VALIDATION), validation),
            ),
            run_dir,
            seed=self._seed,
            on_evaluation=on_evaluation,
            signals=signals,
            restored=restored,
        )

    def evaluate(self, params: Params) -> Mapped:
        """The mapper's poses for the arms of the report."""
        _ = self._optimisation  # starts to compile it in parallel with the evaluation, if there was no training
        return jax.device_get(self._evaluation()(params, *self._inputs))

    def _by_split(self, values: np.ndarray) -> dict[str, np.ndarray]:
        """Values of the arms by split; without a split that has no arms."""
        seen = len(self._arms["train"])
        parts = {"train": values[:seen], "held_out": values[seen:]}
        return {split: part for split, part in parts.items() if part.size}

    def _means(self, values: np.ndarray) -> dict[str, float]:
        return {split: float(part.mean()) for split, part in self._by_split(values).items()}

    def metrics(self, outcome: Mapped) -> Metrics:
        """Means over the arms of a split, and the arm with the largest quality; see `table_of_arms`."""
        table = table_of_arms(self._reference, outcome)
        largest = {split: float(part.max()) for split, part in self._by_split(table["quality"]).items()}
        return {**{name: self._means(column) for name, column in table.items()}, "quality_largest": largest}

    def details(self, outcome: Mapped, controller: str = "mapper") -> Metrics:
        """Similarity of the mapper, the optimum and random initial guesses; and the table of the arms."""
        poses = {
            "mapper": outcome.qpos,
            "nearest_poses": best_poses(self._reference, outcome),
            "random_guesses": self._reference.guessed_qpos,
        }
        few = slice(_SIMILARITY_POSES)
        similarity = mean_similarity(
            self._model.expert,
            self._stacked_arms,
            self._expert_qpos[few],
            {name: np.asarray(qpos)[:, few] for name, qpos in poses.items()},
        )
        by_split = {
            name: {measure: self._means(values) for measure, values in measures.items()}
            for name, measures in similarity.items()
        }
        return {"similarity": by_split, "arms": self._table(outcome)}

    def _table(self, outcome: Mapped) -> dict[str, dict[str, Any]]:
        """The metrics of each arm by its name, with whether it was seen in training and its number of joints."""
        columns = table_of_arms(self._reference, outcome)
        names = [(split == "train", name, arm) for split, arms in self._arms.items() for name, arm in arms.items()]
        return {
            name: {
                "seen": seen,
                "joints": int(arm.is_free.sum()),
                **{key: float(column[i]) for key, column in columns.items()},
            }
            for i, (seen, name, arm) in enumerate(names)
        }

    def status(self, metrics: Metrics) -> str:
        """Distance and quality."""
        quality, distance = metrics["quality"], metrics["mean_distance"]["train"]
        unseen = _cell(quality, "held_out", ", unseen {:.2%}")
        return f"distance {distance:.4f}  above the optimum {quality['train']:.2%}{unseen}"

    def good_enough(self, metrics: Metrics) -> bool:
        """Whether the target quality is reached on the arms seen in training; the others decide nothing."""
        return 0 < self.settings.target_quality >= metrics["quality"]["train"]

    def rows(self, metrics: Metrics) -> list[Row]:
        """Rows of the quality, of what it is compared with, and of the distances that define it."""
        steps = f"{self.settings.refinements} Newton steps"
        rows: tuple[tuple[str, str, str], ...] = (
            ("above the optimum (0 best, 1 a random pose)", METHODS[0], "{:.2%}"),
            ("  the largest of an arm", "quality_largest", "{:.2%}"),
            ("  without Newton steps", METHODS[1], "{:.2%}"),
            (f"  {self.settings.heads} random initial guesses, {steps}", METHODS[2], "{:.2%}"),
            (f"  home, {steps}", METHODS[3], "{:.2%}"),
            ("mean distance", "mean_distance", "{:.4f}"),
            ("  optimal poses", "optimal_distance", "{:.4f}"),
            ("  random poses", "random_distance", "{:.4f}"),
        )
        counts = [str(len(self._arms[split])) for split in _SPLITS]
        cells = [
            (label, _cell(metrics[key], "train", form), _cell(metrics[key], "held_out", form))
            for label, key, form in rows
        ]
        return [("number of arms", counts[0], counts[1]), *cells]

    def save_outcome(self, folder: Path, outcome: Any, controller: str = "policy") -> None:
        """Writes the table of the arms, its plot, and in a run directory a plot of the training."""
        del controller
        from mimic.evaluation import mapper_arms_plot, plots  # imports matplotlib, which takes a second

        table = self._table(outcome)
        _write_table(folder / "arms.csv", table)
        mapper_arms_plot.plot_mapper_arms(table, folder / "arms.png", self.settings.heads, title=self._name)
        labels = {"train": "arms seen in training", "held_out": "unseen arms"}
        plots.plot_training(folder, "quality", "above the optimum [%]", labels=labels, title=self._name)


def _arms_by_split(
    arms: Mapping[str, Mapping[str, ArmArrays]], sampler: Callable[[Array], ArmArrays]
) -> dict[str, Mapping[str, ArmArrays]]:
    """The arms of the report by split; where the config names none that training sees, some that are drawn as there."""
    result = {split: arms[name] for split, name in _SPLITS.items()}
    if not result["train"]:
        drawn = jax.device_get(jax.jit(jax.vmap(sampler))(jax.random.split(_key(_ARMS), _DRAWN_ARMS)))
        result["train"] = {f"drawn {i}": jax.tree.map(lambda x, i=i: x[i], drawn) for i in range(_DRAWN_ARMS)}
    return result


def _key(purpose: int) -> jax.Array:
    return jax.random.fold_in(jax.random.key(_SEED), purpose)


def _cell(values: Mapping[str, float], split: str, form: str) -> str:
    """The value of a split as text; nothing where the split has no arms."""
    return form.format(values[split]) if split in values else ""


def _write_table(file: Path, table: Mapping[str, Mapping[str, Any]]) -> None:
    """Writes one row for each arm."""
    rows = [
        {"arms": SEEN if row["seen"] else UNSEEN, "arm": name, **{key: row[key] for key in row if key != "seen"}}
        for name, row in table.items()
    ]
    text = io.StringIO(newline="")
    writer = csv.DictWriter(text, rows[0])
    writer.writeheader()
    writer.writerows(rows)
    write_atomically(file, text.getvalue())
