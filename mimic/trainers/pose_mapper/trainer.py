"""`trainer=pose_mapper`: trains a network that maps poses of the expert to the nearest poses of the learner."""

import functools
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import jax
import numpy as np

from mimic.base.compilation import Background, compiling
from mimic.retargeting.pose_baselines import copy_joints
from mimic.runs.checkpoints import Checkpoint
from mimic.runs.files import write_csv
from mimic.runs.signals import Signals
from mimic.trainers.config import PoseMapperConfig, TrainConfig
from mimic.trainers.pose_mapper import training
from mimic.trainers.pose_mapper.evaluation import (
    METHODS,
    Mapped,
    Pairs,
    Reference,
    make_reference,
    run_mapper,
    table_of_pairs,
)
from mimic.trainers.pose_mapper.model import make_model
from mimic.trainers.pose_mapper.report_arms import (
    ARMS,
    OTHER_POSES,
    PAIRS,
    TRAINING,
    VALIDATION,
    ManyArms,
    OnePair,
    ReportArms,
)
from mimic.trainers.trainer import Metrics, OnEvaluation, Params, Row, Trainer

Outcome = Mapping[str, Mapped]  # by part of the report


class PoseMapperTrainer(Trainer):
    """Trains a mapper, and compares it with the optimum.

    A mapper of one pair is compared on training poses and on held-out poses. Where the environment draws its learner,
    the mapper to any arm is compared on arms that it has seen and on others.

    Args:
      config: the run's config.
      run_dir: unused, because arms and poses follow from the config and the seed.

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
        make_arms = OnePair if self.model.learner else ManyArms
        self._arms: ReportArms = make_arms(config.env, self.model, self.settings)
        self._objective = training.mapper_objective(self.model, self._arms.sampler)
        self.columns = self._arms.columns
        self.headline = f"{config.env.name}: {self._arms.headline}"

    @functools.cached_property
    def samples(self) -> Mapping[str, Any]:
        """Samples of the training, those of all epochs unless each has fresh ones, and of the validation."""
        return jax.jit(self._draw_samples)(self._seed)

    def _draw_samples(self, seed: int) -> Mapping[str, Any]:
        key, draw = self._arms.key, self._objective.draw
        return {
            "train": draw(jax.random.fold_in(key(TRAINING), seed), self.settings.samples),
            "validation": draw(key(VALIDATION), self.settings.validation_poses),
        }

    @functools.cached_property
    def pairs(self) -> dict[str, Pairs]:
        """The arms and poses of each part of the report."""
        return self._arms.pairs(lambda: self.samples)

    @functools.cached_property
    def _evaluation(self) -> Background[Callable[..., Mapped]]:
        return compiling(functools.partial(run_mapper, self.model), self.params_template(), self.pairs[ARMS])

    @functools.cached_property
    def _optimisation(self) -> Background[Callable[..., Reference]]:
        key = functools.partial(self._arms.key, OTHER_POSES)
        return compiling(functools.partial(make_reference, self.model, key), self.pairs[ARMS])

    @functools.cached_property
    def _reference(self) -> dict[str, Reference]:
        optimise = self._optimisation()
        return {part: jax.device_get(optimise(pairs)) for part, pairs in self.pairs.items()}

    def params_template(self) -> Params:
        """Shapes of the network's parameters."""
        return jax.eval_shape(lambda: self.model.init(jax.random.key(0)))

    def policy(self, params: Params) -> Callable[[Any], Any]:
        """The mapper: pose of the expert -> pose of the learner [rad].

        Raises:
          ValueError: the mapper is a function of a learner too.
        """
        if self.model.learner is None:
            raise ValueError("policy: a mapper to any arm needs a learner; load it with mimic.PoseMapper.load(RUN_DIR)")
        return jax.jit(lambda qpos: self.model(params, self.model.pair().target(qpos)))

    def train(
        self, run_dir: Path, on_evaluation: OnEvaluation, signals: Signals, restored: Checkpoint | None
    ) -> tuple[int, Params]:
        """Trains with the metric as loss, see `mimic.trainers.pose_mapper.training.train`."""
        # Starts to compile these in parallel with the training's functions, the slowest first.
        _ = self._optimisation, self._evaluation
        return training.train(
            self._objective,
            self.settings,
            lambda: (self.samples["train"], self.samples["validation"]),
            run_dir,
            seed=self._seed,
            on_evaluation=on_evaluation,
            signals=signals,
            restored=restored,
        )

    def evaluate(self, params: Params) -> Outcome:
        """The learners' poses for the poses of the report."""
        _ = self._optimisation  # starts to compile it in parallel with the evaluation, if there was no training
        evaluate = self._evaluation()
        return {part: jax.device_get(evaluate(params, pairs)) for part, pairs in self.pairs.items()}

    def metrics(self, outcome: Outcome) -> Metrics:
        """Quality and the distances that define it, means over poses and arms of a split; see `table_of_pairs`.

        Of many arms also the largest quality, and of one pair the angles of its links on held-out poses. Where experts
        are drawn, the metrics of the other experts are in `other_experts`.
        """
        parts = {part: self._part_metrics(part, mapped) for part, mapped in outcome.items()}
        others = {"other_experts": parts[PAIRS]} if PAIRS in parts else {}
        angles = self._angles(outcome[ARMS]) if self.model.learner else {}
        return parts[ARMS] | others | angles

    def _columns(self, part: str, mapped: Mapped, place: tuple[slice, slice]) -> dict[str, np.ndarray]:
        return table_of_pairs(*(jax.tree.map(lambda x: x[place], each) for each in (self._reference[part], mapped)))

    def _part_metrics(self, part: str, mapped: Mapped) -> Metrics:
        tables = {split: self._columns(part, mapped, place) for split, place in self._arms.splits.items()}
        names = next(iter(tables.values()))
        means = {name: {split: float(table[name].mean()) for split, table in tables.items()} for name in names}
        if self.model.learner:
            return means
        return means | {"quality_largest": {split: float(table["quality"].max()) for split, table in tables.items()}}

    def _angles(self, mapped: Mapped) -> Metrics:
        """Median angles [deg] of each link on held-out poses: to the expert's corresponding links, to the optimum."""
        reference, place = self._reference[ARMS], self._arms.splits["held_out"]
        expert_arm, learner_arm = self.model.embodiments
        directions = reference.expert_direction, mapped.direction, reference.optimal_direction
        expert, learner, optimum = (direction[place][0] for direction in directions)
        fractions = self.env_config.metric.link_fractions(expert_arm, learner_arm)
        angles = np.einsum("ij,pij->pj", fractions, _angle(expert[:, :, None], learner[:, None]))
        to_expert, to_optimum = np.median(angles, axis=0), np.median(_angle(learner, optimum), axis=0)
        names = learner_arm.link_names
        return {
            "link_angle_error_deg": float(to_expert.mean()),
            "link_angle_error_deg_by_link": dict(zip(names, map(float, to_expert), strict=True)),
            "link_angle_to_optimum_deg_by_link": dict(zip(names, map(float, to_optimum), strict=True)),
        }

    def details(self, outcome: Outcome, controller: str = "mapper") -> Metrics:
        """Similarity to the environment's expert, and a table of the arms for each part of the report."""
        similarity = self._arms.similarity(self.pairs[ARMS], self._reference[ARMS], outcome[ARMS])
        return {"similarity": similarity, **self._tables(outcome)}

    def _tables(self, outcome: Outcome) -> dict[str, dict[str, dict[str, Any]]]:
        """The metrics of each learner by its name, with whether it was seen in training and its number of joints.

        With other experts a name is that of the expert and that of the learner, as in "ur5e to panda".
        """
        tables = {}
        for part, mapped in outcome.items():
            columns = self._columns(part, mapped, (slice(None), self._arms.table_poses))
            tables[part] = {
                name: {"seen": seen, "joints": joints, **{key: float(column[i]) for key, column in columns.items()}}
                for i, (name, seen, joints) in enumerate(self._arms.rows[part])
            }
        return tables

    def copying_distance(self) -> dict[str, float] | None:
        """Mean distance by split of copying the angles of joints with the same name; None without any such joint."""
        if self.model.learner is None:
            return None
        pair, poses = self.model.pair(), self.pairs[ARMS].expert_qpos
        copied = copy_joints(*self.model.embodiments, poses)
        if copied is None:
            return None
        distance = jax.vmap(lambda qpos, learner_qpos: pair.target(qpos).distance(learner_qpos))
        distances = np.asarray(jax.jit(distance)(poses, copied))
        return {split: float(distances[place].mean()) for split, (_, place) in self._arms.splits.items()}

    def status(self, metrics: Metrics) -> str:
        """Distance and quality."""
        quality, distance = metrics["quality"], metrics["mean_distance"][self._arms.decisive]
        unseen = _cell(quality, self._arms.unseen, ", unseen {:.2%}")
        return f"distance {distance:.4f}  above the optimum {quality['train']:.2%}{unseen}"

    def good_enough(self, metrics: Metrics) -> bool:
        """Whether the target quality is reached on the validation poses, or on the arms seen in training."""
        return 0 < self.settings.target_quality >= metrics["quality"][self._arms.decisive]

    def rows(self, metrics: Metrics) -> list[Row]:
        """Rows of the quality, of what it is compared with, and of the distances that define it."""
        steps = f"{self.settings.refinements} Newton steps"
        guesses = f"  {self.model.starts} random initial guesses, {steps}", METHODS[2], "{:.2%}"
        largest = "  the largest of an arm", "quality_largest", "{:.2%}"
        rows: tuple[tuple[str, str, str], ...] = (
            ("above the optimum (0 best, 1 a random pose)", METHODS[0], "{:.2%}"),
            largest,
            ("  the network's proposals, without Newton steps", METHODS[1], "{:.2%}"),
            guesses,
            (f"  home, {steps}", METHODS[3], "{:.2%}"),
            ("mean distance", "mean_distance", "{:.4f}"),
            ("  optimal poses", "optimal_distance", "{:.4f}"),
            ("  random poses", "random_distance", "{:.4f}"),
        )
        cells = [_row(metrics, *row) for row in rows if row[1] in metrics]
        if self.model.learner:
            to_optimum = max(metrics["link_angle_to_optimum_deg_by_link"].values())
            return [
                *cells,
                ("median angle to the expert's links", "", f"{metrics['link_angle_error_deg']:.1f} deg"),
                ("median angle to the optimum, worst link", "", f"{to_optimum:.1f} deg"),
            ]
        of_others = ("other experts, above the optimum", METHODS[0], "{:.2%}"), largest, guesses
        cells += [_row(metrics["other_experts"], *row) for row in of_others if "other_experts" in metrics]
        counts = [str(sum(row.seen is seen for row in self._arms.rows[ARMS])) for seen in (True, False)]
        return [("number of arms", counts[0], counts[1]), *cells]

    def save_outcome(self, folder: Path, outcome: Any, controller: str = "policy") -> None:
        """Writes a table of each part, a plot of many arms, and in a run directory a plot of the training."""
        del controller
        from mimic.evaluation import plots  # imports matplotlib, which takes a second

        tables = self._tables(outcome)
        for part, table in tables.items():
            keys = [key for key in next(iter(table.values())) if key != "seen"]
            rows = [
                ("seen" if row["seen"] else "unseen", name, *(row[key] for key in keys)) for name, row in table.items()
            ]
            write_csv(folder / f"{part}.csv", ["arms", "arm", *keys], rows)
        label, labels = "above the optimum [%]", plots.labels_of("poses")
        if self.model.learner is None:
            texts = (
                "mapper",
                "the network's proposals, without Newton steps",
                f"Newton steps from {self.model.starts} random guesses",
                "Newton steps from home",
            )
            series: dict[str, str] = dict(zip(METHODS, texts, strict=True))
            plots.plot_arms(tables[ARMS], series, folder / "arms.png", label=label, title=self._name)
            labels = {"train": "arms seen in training", "held_out": "unseen arms"}
        plots.plot_training(folder, "quality", label, labels=labels, title=self._name)


def _cell(values: Mapping[str, float], split: str, form: str) -> str:
    """The value of a split as text; nothing where the split has no arms."""
    return form.format(values[split]) if split in values else ""


def _row(metrics: Mapping[str, Any], label: str, key: str, form: str) -> Row:
    return label, _cell(metrics[key], "train", form), _cell(metrics[key], "held_out", form)


def _angle(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Angles [deg] between unit vectors along the last axis."""
    return np.degrees(np.arccos(np.clip((a * b).sum(axis=-1), -1, 1)))
