"""`trainer=pose_mapper` where the environment draws its learner: trains one mapper to any arm."""

import functools
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import jax
import numpy as np
from jaxtyping import Array

from mimic.arms.arrays import ArmArrays, stack_arms
from mimic.base.compilation import Background, compiling
from mimic.envs.family import SEEN, UNSEEN, arm_sampler, report_arms
from mimic.runs.checkpoints import Checkpoint
from mimic.runs.files import write_csv
from mimic.runs.signals import Signals
from mimic.trainers.config import PoseMapperConfig, TrainConfig
from mimic.trainers.pose_mapper import training
from mimic.trainers.pose_mapper.any_arm_evaluation import (
    METHODS,
    Mapped,
    Pairs,
    Reference,
    best_poses,
    make_reference,
    mean_similarity,
    run_mapper,
    table_of_pairs,
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
# Parts of the report, by their key: each arm imitates the environment's expert, and another arm of its split.
_ARMS_PART, _PAIRS_PART = "arms", "pairs"

Outcome = Mapping[str, Mapped]  # by part of the report


class AnyArmMapperTrainer(Trainer):
    """Trains a mapper to any arm, and compares it with the optimum on arms that it has seen and on others.

    Both columns of the report are on the same poses of the environment's expert, which are in no training. Where
    experts are drawn too, each arm of a column also imitates the one before it.

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
        self.settings: PoseMapperConfig = config.trainer
        self._name, self._seed = config.env.name, config.seed % 2**31  # the range of a 32-bit integer
        self.total_steps = self.settings.total_steps
        self.env_config = config.env
        self._model = make_any_arm_model(config.env, self.settings)
        sampler = arm_sampler(config.env)
        self._objective = any_arm_objective(self._model, sampler)
        self._arms = _arms_by_split(report_arms(config.env), sampler)
        counts = " and ".join(f"{len(self._arms[split])} {name}" for split, name in _SPLITS.items())
        experts = "any arm" if self._model.expert_is_drawn else config.env.expert.model
        kind = "fresh arms and poses in each epoch" if self.settings.fresh else "training arms and poses"
        self.headline = (
            f"{config.env.name}: {experts} to any arm, {self.settings.samples} {kind}, report on {counts} arms"
        )

    @functools.cached_property
    def _arm_before(self) -> list[int]:
        """Number of the arm before each one in its split; before the first is the last."""
        indices, start = [], 0
        for arms in self._arms.values():
            indices += np.roll(np.arange(start, start + len(arms)), 1).tolist()
            start += len(arms)
        return indices

    @functools.cached_property
    def _pairs(self) -> dict[str, Pairs]:
        """The arms and poses of each part of the report; all parts have the same shapes."""
        arms = [arm.astype(np.float32) for of_split in self._arms.values() for arm in of_split.values()]
        experts = {_ARMS_PART: [self._model.expert] * len(arms)}
        if self._model.expert_is_drawn:
            experts[_PAIRS_PART] = [arms[i] for i in self._arm_before]
        keys = jax.random.split(_key(_HELD_OUT), self.settings.held_out_poses)
        draw = jax.jit(jax.vmap(jax.vmap(random_pose, (None, 0)), (0, None)))
        stacked = {part: stack_arms(of_part) for part, of_part in experts.items()}
        return {
            part: Pairs(of_part, stack_arms(arms), np.asarray(draw(of_part, keys))) for part, of_part in stacked.items()
        }

    @functools.cached_property
    def _evaluation(self) -> Background[Callable[..., Mapped]]:
        return compiling(functools.partial(run_mapper, self._model), self.params_template(), self._pairs[_ARMS_PART])

    @functools.cached_property
    def _optimisation(self) -> Background[Callable[..., Reference]]:
        return compiling(functools.partial(make_reference, self._model), _key(_GUESSES), self._pairs[_ARMS_PART])

    @functools.cached_property
    def _reference(self) -> dict[str, Reference]:
        optimise = self._optimisation()
        return {part: jax.device_get(optimise(_key(_GUESSES), pairs)) for part, pairs in self._pairs.items()}

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

    def evaluate(self, params: Params) -> Outcome:
        """The mapper's poses for the arms of the report."""
        _ = self._optimisation  # starts to compile it in parallel with the evaluation, if there was no training
        evaluate = self._evaluation()
        return {part: jax.device_get(evaluate(params, pairs)) for part, pairs in self._pairs.items()}

    def _by_split(self, values: np.ndarray) -> dict[str, np.ndarray]:
        """Values of the arms by split; without a split that has no arms."""
        seen = len(self._arms["train"])
        parts = {"train": values[:seen], "held_out": values[seen:]}
        return {split: part for split, part in parts.items() if part.size}

    def _means(self, values: np.ndarray) -> dict[str, float]:
        return {split: float(part.mean()) for split, part in self._by_split(values).items()}

    def metrics(self, outcome: Outcome) -> Metrics:
        """Means over the arms of a split, and the arm with the largest quality; see `table_of_pairs`.

        Those of the environment's expert; where experts are drawn, those of the other experts are in `other_experts`.
        """
        parts = {part: self._part_metrics(part, mapped) for part, mapped in outcome.items()}
        others = {"other_experts": parts[_PAIRS_PART]} if _PAIRS_PART in parts else {}
        return parts[_ARMS_PART] | others

    def _part_metrics(self, part: str, mapped: Mapped) -> Metrics:
        table = table_of_pairs(self._reference[part], mapped)
        largest = {split: float(values.max()) for split, values in self._by_split(table["quality"]).items()}
        return {**{name: self._means(column) for name, column in table.items()}, "quality_largest": largest}

    def details(self, outcome: Outcome, controller: str = "mapper") -> Metrics:
        """Similarity of the mapper, the optimum and random initial guesses to the environment's expert; and tables."""
        pairs, reference, mapped = self._pairs[_ARMS_PART], self._reference[_ARMS_PART], outcome[_ARMS_PART]
        poses = {
            "mapper": mapped.qpos,
            "nearest_poses": best_poses(reference, mapped),
            "random_guesses": reference.guessed_qpos,
        }
        few = slice(_SIMILARITY_POSES)
        similarity = mean_similarity(
            pairs._replace(expert_qpos=pairs.expert_qpos[:, few]),
            {name: np.asarray(qpos)[:, few] for name, qpos in poses.items()},
        )
        by_split = {
            name: {measure: self._means(values) for measure, values in measures.items()}
            for name, measures in similarity.items()
        }
        return {"similarity": by_split, **{part: self._table(part, mapped) for part, mapped in outcome.items()}}

    def _table(self, part: str, mapped: Mapped) -> dict[str, dict[str, Any]]:
        """The metrics of each learner by its name, with whether it was seen in training and its number of joints.

        With other experts a name is that of the expert and that of the learner, as in "ur5e to panda".
        """
        columns = table_of_pairs(self._reference[part], mapped)
        arms = [(split == "train", name, arm) for split, arms in self._arms.items() for name, arm in arms.items()]
        names = [name for _, name, _ in arms]
        if part == _PAIRS_PART:
            names = [f"{names[expert]} to {name}" for expert, name in zip(self._arm_before, names, strict=True)]
        return {
            name: {
                "seen": seen,
                "joints": int(arm.is_free.sum()),
                **{key: float(column[i]) for key, column in columns.items()},
            }
            for i, (name, (seen, _, arm)) in enumerate(zip(names, arms, strict=True))
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
        guesses = f"  {self._model.starts} random initial guesses, {steps}"
        rows: tuple[tuple[str, str, str], ...] = (
            ("above the optimum (0 best, 1 a random pose)", METHODS[0], "{:.2%}"),
            ("  the largest of an arm", "quality_largest", "{:.2%}"),
            ("  the network's proposals, without Newton steps", METHODS[1], "{:.2%}"),
            (guesses, METHODS[2], "{:.2%}"),
            (f"  home, {steps}", METHODS[3], "{:.2%}"),
            ("mean distance", "mean_distance", "{:.4f}"),
            ("  optimal poses", "optimal_distance", "{:.4f}"),
            ("  random poses", "random_distance", "{:.4f}"),
        )
        of_others = (("other experts, above the optimum", *rows[0][1:]), *rows[1:2], (guesses, METHODS[2], "{:.2%}"))
        counts = [str(len(self._arms[split])) for split in _SPLITS]
        cells = [_row(metrics, *row) for row in rows]
        cells += [_row(metrics["other_experts"], *row) for row in of_others if "other_experts" in metrics]
        return [("number of arms", counts[0], counts[1]), *cells]

    def save_outcome(self, folder: Path, outcome: Any, controller: str = "policy") -> None:
        """Writes a table of each part, a plot of the arms, and in a run directory a plot of the training."""
        del controller
        from mimic.evaluation import plots  # imports matplotlib, which takes a second

        tables = {part: self._table(part, mapped) for part, mapped in outcome.items()}
        for part, table in tables.items():
            _write_table(folder / f"{part}.csv", table)
        texts = (
            "mapper",
            "the network's proposals, without Newton steps",
            f"Newton steps from {self._model.starts} random guesses",
            "Newton steps from home",
        )
        series: dict[str, str] = dict(zip(METHODS, texts, strict=True))
        label = "above the optimum [%]"
        plots.plot_arms(tables[_ARMS_PART], series, folder / "arms.png", label=label, title=self._name)
        labels = {"train": "arms seen in training", "held_out": "unseen arms"}
        plots.plot_training(folder, "quality", label, labels=labels, title=self._name)


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


def _row(metrics: Mapping[str, Any], label: str, key: str, form: str) -> Row:
    return label, _cell(metrics[key], "train", form), _cell(metrics[key], "held_out", form)


def _write_table(file: Path, table: Mapping[str, Mapping[str, Any]]) -> None:
    """Writes one row for each arm."""
    keys = [key for key in next(iter(table.values())) if key != "seen"]
    rows = [(SEEN if row["seen"] else UNSEEN, name, *(row[key] for key in keys)) for name, row in table.items()]
    write_csv(file, ["arms", "arm", *keys], rows)
