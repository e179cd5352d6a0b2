"""Functions that move and measure any learner, compiled once: the arm, its locks and the weights are arguments."""

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from concurrent.futures import wait as wait_for
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from mimic.arms.arm import Arm, ArmConfig, build_arm
from mimic.arms.arrays import MAX_JOINTS, ArmArrays, arm_arrays
from mimic.metric.correspondence import arc_length_correspondence
from mimic.metric.distance import DistanceWeights, Metric
from mimic.metric.kinematics import link_states
from mimic.metric.similarity import centre_line, similarity
from mimic.retargeting.array_nearest import nearest_pose
from mimic.trainers.pose_mapper.any_arm_mapper import AnyArmMapper
from mimic.trainers.pose_mapper.any_arm_model import AnyArmMapperModel, expert_pose
from mimic.trainers.pose_mapper.any_arm_training import random_pose
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


class _Compiled(NamedTuple):
    """Compiled functions of padded poses [rad], the weights (translation, rotation) and a learner.

    Attributes:
      track: (expert_qpos, weights, learner) -> the mapper's pose [rad].
      compare: (expert_qpos, learner_qpos, weights, learner) -> `PoseComparison`, with empty slots of links.
      best: (expert_qpos, guess, weights, learner) -> the best pose [rad], and its distance.
    """

    track: Callable[..., Array]
    compare: Callable[..., PoseComparison]
    best: Callable[..., tuple[Array, Array]]


class AnyLearnerFunctions:
    """The functions of all learners with any of their joints locked, compiled once in a background thread.

    Args:
      mapper: moves the learner.
      learners: that can be chosen.
    """

    def __init__(self, mapper: AnyArmMapper, learners: Sequence[AnyLearner]):
        self._expert, self._learners = mapper.expert, learners
        executor = ThreadPoolExecutor(1, "compile")
        self._compiled = executor.submit(_compile, mapper)
        executor.shutdown(wait=False)

    def get(self, settings: Settings) -> CompiledFunctions | None:
        """The functions; None until they are compiled."""
        return self.wait(settings) if self._compiled.done() else None

    def is_complete(self, settings: Settings) -> bool:
        """Whether the functions are compiled, or their compilation has failed."""
        return self._compiled.done()

    def wait(self, settings: Settings) -> CompiledFunctions:
        """Waits for the functions and returns them."""
        functions, learner = self._compiled.result(), self._learners[settings.arm]
        arrays, joints = learner.with_locks(settings.locked), learner.arm.embodiment.num_joints
        links = self._expert.num_links, learner.arm.embodiment.num_links

        def track(qpos: Array, current: Array, weights: Array) -> np.ndarray:
            return np.asarray(functions.track(_padded(qpos), weights, arrays))[:joints]

        def compare(qpos: Array, learner_qpos: Array, weights: Array) -> PoseComparison:
            comparison = functions.compare(_padded(qpos), _padded(learner_qpos), weights, arrays)
            return _without_empty_slots(comparison, *links)

        def best(qpos: Array, weights: Array) -> tuple[np.ndarray, Array]:
            expert_qpos = _padded(qpos)
            guess = functions.track(expert_qpos, weights, arrays)
            nearest, distance = functions.best(expert_qpos, guess, weights, arrays)
            return np.asarray(nearest)[:joints], distance

        return CompiledFunctions(learner.arm, track, compare, best)

    def finish(self) -> None:
        """Waits for the compilation: a process must not end during it."""
        wait_for([self._compiled])


def _compile(mapper: AnyArmMapper) -> _Compiled:
    def model_of(weights: Array) -> AnyArmMapperModel:
        return dataclasses.replace(mapper.model, weights=DistanceWeights(weights[0], weights[1]))

    def track(qpos: Array, weights: Array, learner: ArmArrays) -> Array:
        return model_of(weights)(mapper.params, expert_pose(mapper.model.expert, qpos), learner)

    def compare(qpos: Array, learner_qpos: Array, weights: Array, learner: ArmArrays) -> PoseComparison:
        expert, matrix = mapper.model.expert, arc_length_correspondence(mapper.model.expert, learner)
        metric = Metric(matrix, model_of(weights).weights)
        links = metric.link_distances(link_states(expert, qpos), link_states(learner, learner_qpos))
        lines = centre_line(expert, qpos), centre_line(learner, learner_qpos)
        return PoseComparison(metric.reduced(links), matrix, links, similarity(*lines))

    def best(qpos: Array, guess: Array, weights: Array, learner: ArmArrays) -> tuple[Array, Array]:
        model, expert = model_of(weights), expert_pose(mapper.model.expert, qpos)
        matrix, keys = arc_length_correspondence(model.expert, learner), jax.random.split(jax.random.key(0), _GUESSES)
        random = jax.vmap(lambda key: random_pose(learner, key))(keys)
        guesses = jnp.concatenate([random, jnp.stack([jnp.asarray(learner.home), guess])])
        poses = jax.vmap(lambda at: nearest_pose(learner, model.weights, matrix, expert.states, at, _STEPS).qpos)(
            guesses
        )
        poses = jnp.concatenate([poses, guess[None]])  # the steps have no line search
        distances = model.distances(expert, learner, poses)
        nearest = jnp.argmin(distances)
        return poses[nearest], distances[nearest]

    learner = mapper.model.expert  # any other arm has the same shapes
    pose, weights = np.zeros(MAX_JOINTS, np.float32), np.ones(2, np.float32)
    return _Compiled(
        compiled(track, pose, weights, learner),
        compiled(compare, pose, pose, weights, learner),
        compiled(best, pose, pose, weights, learner),
    )


def _padded(qpos: Any) -> Float[np.ndarray, "8"]:
    pose = np.asarray(qpos, np.float32)
    return np.concatenate([pose, np.zeros(MAX_JOINTS - len(pose), np.float32)])


def _without_empty_slots(comparison: PoseComparison, expert_links: int, learner_links: int) -> PoseComparison:
    """The comparison of the links that the arms have; W sums to the number of its entries."""
    matrix, links = (np.asarray(x)[:expert_links, :learner_links] for x in (comparison.matrix, comparison.links))
    scale = matrix.size / np.asarray(comparison.matrix).size
    return comparison._replace(matrix=scale * matrix, links=links)
