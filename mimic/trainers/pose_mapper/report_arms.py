"""The arms and poses of a pose mapper's report: one pair on poses of three kinds, or many arms on the same poses."""

import abc
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Array

from mimic.arms.arrays import ArmArrays, stack_arms
from mimic.arms.sampler import Sampler
from mimic.envs.config import EnvConfig
from mimic.envs.family import SEEN, UNSEEN, arm_sampler
from mimic.envs.family import report_arms as arms_of_report
from mimic.evaluation.rollout_metrics import centre_lines, means_by_split, measure_similarity, pose_similarity
from mimic.trainers.config import PoseMapperConfig
from mimic.trainers.pose_mapper.evaluation import Mapped, Pairs, Reference, best_poses
from mimic.trainers.pose_mapper.model import MapperModel
from mimic.trainers.pose_mapper.pair import random_poses
from mimic.trainers.trainer import Metrics

# Numbers of the random keys. A run's seed changes the network and the training; the evaluation is the same in all runs.
TRAINING, VALIDATION, HELD_OUT, OTHER_POSES, _ARMS = range(5)
_SIMILARITY_POSES = 500, 32  # of one pair, where inverse kinematics takes a millisecond each; and of each of many arms
_DRAWN_ARMS = 16  # of the report, where the config names none that training sees
# Parts of the report, by their key: each arm imitates the environment's expert, and another arm of its split.
ARMS, PAIRS = "arms", "pairs"


class Row(NamedTuple):
    """An arm of the report: its name, whether training has seen it, and its number of joints."""

    name: str
    seen: bool
    joints: int


class ReportArms(abc.ABC):
    """The arms and poses of a report.

    Attributes:
      headline: one line for people, after the name of the environment.
      columns: headers of the splits "train" and "held_out".
      sampler: draws the arms of a training; None where they are constants.
      decisive, unseen: splits that decide when training ends, and that are shown beside that of the training.
      splits: places of each split in the arrays [pairs, poses].
      table_poses: poses of the table.
      rows: arms of each part of the report.
    """

    headline: str
    columns: tuple[str, str]
    sampler: Sampler | None
    decisive: str
    unseen: str
    splits: Mapping[str, tuple[slice, slice]]
    table_poses: slice = slice(None)
    rows: Mapping[str, list[Row]]

    @abc.abstractmethod
    def key(self, purpose: int) -> Array:
        """A random key that depends on its purpose alone."""

    @abc.abstractmethod
    def pairs(self, samples: Callable[[], Mapping[str, Any]]) -> dict[str, Pairs]:
        """Pairs of arms and poses of each part of the report; `samples` gives those of "train" and "validation"."""

    @abc.abstractmethod
    def similarity(self, pairs: Pairs, reference: Reference, mapped: Mapped) -> Metrics:
        """Similarity of some poses of the mapper and the optimum to the expert's, as {method: {measure: {split: }}}."""


class OnePair(ReportArms):
    """The mapper's own pair: some poses of the training, those that end it early, and held-out ones."""

    columns = ("training", "held out")
    sampler = None
    decisive = unseen = "validation"

    def __init__(self, env: EnvConfig, model: MapperModel, settings: PoseMapperConfig):
        self._model, self._held_out = model, settings.held_out_poses
        expert, learner = model.pair().expert, model.pair().learner
        kind = "fresh poses in each epoch" if settings.fresh else "training poses"
        self.headline = f"{expert.name} to {learner.name}, {settings.samples} {kind}"
        self.rows = {ARMS: [Row(learner.name, True, learner.num_joints)]}
        self._few = min(settings.validation_poses, settings.samples)
        end = self._few + settings.validation_poses
        parts = {"train": slice(self._few), "validation": slice(self._few, end), "held_out": slice(end, None)}
        self.splits = {split: (slice(None), part) for split, part in parts.items()}
        self.table_poses = parts["held_out"]

    def key(self, purpose: int) -> Array:
        """See `ReportArms`."""
        return jax.random.fold_in(jax.random.key(0), purpose)

    def pairs(self, samples: Callable[[], Mapping[str, Any]]) -> dict[str, Pairs]:
        """See `ReportArms`."""
        poses = random_poses(self._model.expert.data, self.key(HELD_OUT), (self._held_out,))
        parts = samples()["train"][: self._few], samples()["validation"], poses
        return {ARMS: Pairs(None, None, np.concatenate(parts))}

    def similarity(self, pairs: Pairs, reference: Reference, mapped: Mapped) -> Metrics:
        """See `ReportArms`; of held-out poses and the baselines too."""
        few = slice(self.table_poses.start, self.table_poses.start + _SIMILARITY_POSES[0])
        expert_qpos, mapped_qpos, optimal_qpos = (
            np.asarray(qpos)[few, None] for qpos in (pairs.expert_qpos, mapped.qpos[0], reference.optimal_qpos[0])
        )  # motions of one sample
        poses = {"mapper": mapped_qpos, "nearest_poses": optimal_qpos}
        expert, learner = self._model.embodiments
        return pose_similarity(expert, learner, expert_qpos, poses, split="held_out")


class ManyArms(ReportArms):
    """Arms that training has seen and others, on the same poses of the environment's expert, which are in no training.

    Where experts are drawn too, each arm of a split also imitates the one before it.
    """

    columns = ("seen arms", "unseen arms")
    decisive, unseen = "train", "held_out"

    def __init__(self, env: EnvConfig, model: MapperModel, settings: PoseMapperConfig):
        self._model, self._poses = model, settings.held_out_poses
        self.sampler = arm_sampler(env)
        by_split = self._arms_by_split(env)
        counts = " and ".join(f"{len(by_split[split])} {split}" for split in (SEEN, UNSEEN))
        experts = "any arm" if model.takes_any_expert else env.expert.model
        kind = "fresh arms and poses in each epoch" if settings.fresh else "training arms and poses"
        self.headline = f"{experts} to any arm, {settings.samples} {kind}, report on {counts} arms"
        self._arms = [arm.astype(np.float32) for arms in by_split.values() for arm in arms.values()]
        seen, count = len(by_split[SEEN]), len(self._arms)
        places = {"train": slice(seen), "held_out": slice(seen, count)}
        self.splits = {split: (rows, slice(None)) for split, rows in places.items() if range(count)[rows]}
        names = [name for arms in by_split.values() for name in arms]
        # Number of the arm before each one in its split; before the first is the last.
        self._arm_before = np.concatenate([np.roll(np.arange(count)[rows], 1) for rows in places.values()])
        names_of = {
            ARMS: names,
            PAIRS: [f"{names[i]} to {name}" for i, name in zip(self._arm_before, names, strict=True)],
        }
        self.rows = {
            part: [Row(name, i < seen, int(self._arms[i].is_free.sum())) for i, name in enumerate(names_of[part])]
            for part in ([ARMS, PAIRS] if model.takes_any_expert else [ARMS])
        }

    def key(self, purpose: int) -> Array:
        """See `ReportArms`."""
        return jax.random.fold_in(jax.random.key(2**20), purpose)  # a small seed would be that of a training too

    def _arms_by_split(self, env: EnvConfig) -> Mapping[str, Mapping[str, ArmArrays]]:
        """The arms of the report; where the config names none that training sees, some that are drawn as there."""
        arms = arms_of_report(env)
        if arms[SEEN]:
            return arms
        assert self.sampler is not None
        drawn = jax.device_get(jax.jit(jax.vmap(self.sampler))(jax.random.split(self.key(_ARMS), _DRAWN_ARMS)))
        return {**arms, SEEN: {f"drawn {i}": jax.tree.map(lambda x, i=i: x[i], drawn) for i in range(_DRAWN_ARMS)}}

    def pairs(self, samples: Callable[[], Mapping[str, Any]]) -> dict[str, Pairs]:
        """See `ReportArms`; all parts have the same shapes."""
        del samples
        experts = {ARMS: [self._model.expert.data] * len(self._arms), PAIRS: [self._arms[i] for i in self._arm_before]}
        keys = jax.random.split(self.key(HELD_OUT), self._poses)
        draw = jax.jit(jax.vmap(jax.vmap(random_poses, (None, 0)), (0, None)))
        stacked = {part: stack_arms(experts[part]) for part in self.rows}
        learners = stack_arms(self._arms)
        return {part: Pairs(arms, learners, np.asarray(draw(arms, keys))) for part, arms in stacked.items()}

    def similarity(self, pairs: Pairs, reference: Reference, mapped: Mapped) -> Metrics:
        """See `ReportArms`; of random initial guesses too."""
        poses = {
            "mapper": mapped.qpos,
            "nearest_poses": best_poses(reference, mapped),
            "random_guesses": reference.guessed_qpos,
        }
        few, learners = slice(_SIMILARITY_POSES[1]), pairs.learners
        assert learners is not None
        line = jax.device_get(centre_lines(pairs.experts, pairs.expert_qpos[:, few]))
        tables = {name: measure_similarity(line, learners, qpos[:, few]) for name, qpos in poses.items()}
        return means_by_split(tables, {split: rows for split, (rows, _) in self.splits.items()})
