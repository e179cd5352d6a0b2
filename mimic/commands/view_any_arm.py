"""Functions that move and measure any learner, compiled once: the arm, its locks and the weights are arguments."""

import contextlib
import dataclasses
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from mimic.arms.arm import Arm, ArmConfig, build_arm
from mimic.arms.arrays import MAX_JOINTS, ArmArrays, arm_arrays
from mimic.base.compilation import in_background
from mimic.metric.distance import DistanceWeights
from mimic.metric.kinematics import link_states
from mimic.metric.similarity import centre_line, similarity
from mimic.trainers.pose_mapper.mapper import PoseMapper
from mimic.trainers.pose_mapper.pair import Pair, Target, random_poses
from mimic.viewer.tracking import CompiledFunctions, PoseComparison, Preset, Settings, compiled

# The kinematic bound: Newton steps from random poses, home and the mapper's pose. On Pandas with locked joints and on
# four real arms it is at most 0.01 above that of 200 poses and 24 steps, in the mean at most 3e-4.
_GUESSES, _STEPS = 32, 12


@dataclasses.dataclass(frozen=True, eq=False)
class AnyLearner:
    """A learner whose joints can all be locked.

    Attributes:
      config: without locked joints.
      arm: without locked joints.
      arrays: the same, in single precision.
    """

    config: ArmConfig
    arm: Arm
    arrays: ArmArrays

    def with_locks(self, locked: Mapping[str, float]) -> ArmArrays:
        """The arrays with joints locked at angles [rad]."""
        home, is_free = np.array(self.arrays.home), np.array(self.arrays.is_free)
        for joint, name in enumerate(self.arm.embodiment.joint_names):
            if name in locked:
                home[joint], is_free[joint] = locked[name], 0.0
        return dataclasses.replace(self.arrays, home=home, is_free=is_free)


def read_learners(
    learners: Mapping[str, ArmConfig], limits: str, links: str
) -> tuple[tuple[AnyLearner, ...], tuple[Preset, ...]]:
    """The different arms among learners, and what can be chosen: the learners, and each of the arms without locks.

    Args:
      learners: by the name on the page.
      limits: see `EnvConfig`.
      links: see `MetricConfig`.

    Raises:
      ValueError: an arm that cannot be loaded, is a tree, or has too many joints or links.
    """
    arms: list[AnyLearner] = []
    presets: list[Preset] = []
    for name, config in learners.items():
        try:
            whole = dataclasses.replace(config, locked=None)
            if all(whole != arm.config for arm in arms):
                arm = build_arm(whole, limits, links)
                arms.append(AnyLearner(whole, arm, arm_arrays(arm).astype(np.float32)))
            locked = build_arm(config, limits, links).locked if config.locked else {}
        except ValueError as error:
            raise ValueError(f"learners: {name}: {error}") from None
        presets.append(Preset(name, [arm.config for arm in arms].index(whole), locked))
    for index, arm in enumerate(arms):
        if all(preset.arm != index or preset.locked for preset in presets):
            presets.append(Preset(Path(arm.config.model).stem, index, {}))
    return tuple(arms), tuple(presets)


class AnyLearnerFunctions:
    """The functions of all learners with any of their joints locked, compiled once in a background thread.

    Args:
      mapper: moves the learner.
      learners: that can be chosen.
    """

    def __init__(self, mapper: PoseMapper, learners: Sequence[AnyLearner]):
        self._expert, self._learners = mapper.expert, learners
        self._compiled = in_background(lambda: _compile(mapper))

    def get(self, settings: Settings) -> CompiledFunctions | None:
        """The functions; None until they are compiled."""
        return self.wait(settings) if self.is_complete(settings) else None

    def is_complete(self, settings: Settings) -> bool:
        """Whether the functions are compiled, or their compilation has failed."""
        del settings
        return self._compiled.done

    def wait(self, settings: Settings) -> CompiledFunctions:
        """Waits for the functions and returns them."""
        (to_mapped, to_comparison, to_best), learner = self._compiled(), self._learners[settings.arm]
        arrays, joints = learner.with_locks(settings.locked), learner.arm.embodiment.num_joints
        links = self._expert.num_links, learner.arm.embodiment.num_links

        def track(qpos: Array, current: Array, weights: Array) -> np.ndarray:
            return np.asarray(to_mapped(_padded(qpos), weights, arrays))[:joints]

        def compare(qpos: Array, learner_qpos: Array, weights: Array) -> PoseComparison:
            comparison = to_comparison(_padded(qpos), _padded(learner_qpos), weights, arrays)
            return _without_empty_slots(comparison, *links)

        def best(qpos: Array, weights: Array) -> tuple[np.ndarray, Array]:
            distance, nearest = to_best(_padded(qpos), to_mapped(_padded(qpos), weights, arrays), weights, arrays)
            return np.asarray(nearest)[:joints], distance

        return CompiledFunctions(learner.arm, track, compare, best)

    def finish(self) -> None:
        """Waits for the compilation: a process must not end during it."""
        with contextlib.suppress(Exception):  # raised by `wait`
            self._compiled()


def _compile(mapper: PoseMapper) -> tuple[Callable[..., Any], ...]:
    """Compiled functions of padded poses [rad], the weights (translation, rotation) and a learner.

    The mapper's pose (expert_qpos, weights, learner); a `PoseComparison` with empty slots of links (expert_qpos,
    learner_qpos, weights, learner); the smallest distance and its pose (expert_qpos, guess, weights, learner).
    """
    model, expert = mapper.model, mapper.model.expert.data

    def target_of(qpos: Array, weights: Array, learner: ArmArrays) -> Target:
        return Pair.of_arrays(expert, learner, DistanceWeights(weights[0], weights[1])).target(qpos)

    def track(qpos: Array, weights: Array, learner: ArmArrays) -> Array:
        return model(mapper.params, target_of(qpos, weights, learner))

    def compare(qpos: Array, learner_qpos: Array, weights: Array, learner: ArmArrays) -> PoseComparison:
        target = target_of(qpos, weights, learner)
        metric = target.pair.metric
        links = metric.link_distances(target.states, link_states(learner, learner_qpos))
        lines = centre_line(expert, qpos), centre_line(learner, learner_qpos)
        return PoseComparison(metric.reduced(links), metric.matrix(links), links, similarity(*lines))

    def best(qpos: Array, guess: Array, weights: Array, learner: ArmArrays) -> tuple[Array, Array]:
        target, keys = target_of(qpos, weights, learner), jax.random.split(jax.random.key(0), _GUESSES)
        random = jax.vmap(lambda key: random_poses(learner, key))(keys)
        poses = target.improved(jnp.concatenate([random, jnp.stack([jnp.asarray(learner.home), guess])]), _STEPS)
        return target.nearest(jnp.concatenate([poses, guess[None]]))  # the steps have no line search

    pose, weights = np.zeros(MAX_JOINTS, np.float32), np.ones(2, np.float32)  # any other arm has the expert's shapes
    return (
        compiled(track, pose, weights, expert),
        compiled(compare, pose, pose, weights, expert),
        compiled(best, pose, pose, weights, expert),
    )


def _padded(qpos: Any) -> Float[np.ndarray, "8"]:
    pose = np.asarray(qpos, np.float32)
    return np.concatenate([pose, np.zeros(MAX_JOINTS - len(pose), np.float32)])


def _without_empty_slots(comparison: PoseComparison, expert_links: int, learner_links: int) -> PoseComparison:
    """The comparison of the links that the arms have; W sums to the number of its entries."""
    matrix, links = (np.asarray(x)[:expert_links, :learner_links] for x in (comparison.matrix, comparison.links))
    scale = matrix.size / np.asarray(comparison.matrix).size
    return comparison._replace(matrix=scale * matrix, links=links)
