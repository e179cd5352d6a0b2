"""A trained pose mapper to any arm, for all learners or for one of them."""

import dataclasses
import functools
import os
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Float, Int

from mimic.any_arm.arrays import MAX_JOINTS, MAX_LINKS, ArmArrays, arm_arrays, masked_arrays
from mimic.any_arm.kinematics import link_states
from mimic.arms.arm import Arm, ArmConfig, build_arm
from mimic.arms.embodiment import Embodiment
from mimic.envs import env_config, environments
from mimic.envs.config import ArmsConfig, EnvConfig
from mimic.metric.config import MetricConfig
from mimic.runs.checkpoints import load_checkpoint
from mimic.trainers.config import PoseMapperConfig, TrainConfig
from mimic.trainers.pose_mapper.any_arm_model import AnyArmMapperModel, Params, make_any_arm_model
from mimic.trainers.pose_mapper.model import PoseMapper, check_poses
from mimic.trainers.run_config import load_config

Learner = ArmArrays | Arm | ArmConfig | str | os.PathLike[str]


@dataclasses.dataclass(frozen=True, eq=False)
class DescribedArm:
    """An arm and the arrays that the network takes.

    Attributes:
      arm: with its locked joints.
      arrays: in single precision.
      joints: slot of each of the arm's joints in the arrays.
      slots: name of the joint in each of the first slots, locked ones included.
    """

    arm: Arm
    arrays: ArmArrays
    joints: Int[np.ndarray, " learner_joints"]
    slots: tuple[str, ...]

    @classmethod
    def without_locks(cls, arm: Arm) -> "DescribedArm":
        """An arm whose locked joints have no slot."""
        names = arm.embodiment.joint_names
        return cls(arm, arm_arrays(arm).astype(np.float32), np.arange(len(names)), names)


@dataclasses.dataclass(frozen=True, eq=False)
class AnyArmMapper:
    """A trained mapper to any arm: call it with poses of the expert and a learner.

    Attributes:
      model: network, expert and metric.
      params: parameters of the network.
      expert: the arm of the input poses.
      env: config of the environment; learners that are no arrays are built with its `limits` and `metric.links`.
      report: of `mimic.load`: the metrics of these weights, as in report.json of a run, and where they come from.
    """

    model: AnyArmMapperModel
    params: Params
    expert: Embodiment
    env: EnvConfig
    report: Mapping[str, Any] = dataclasses.field(default_factory=dict)

    @classmethod
    def load(cls, run_dir: str | os.PathLike[str], checkpoint: int | None = None) -> "AnyArmMapper":
        """Loads the mapper of a run of `python -m mimic.train trainer=pose_mapper env=any_arm`.

        Args:
          run_dir: the run directory.
          checkpoint: number of training poses of the checkpoint; the last checkpoint where None.

        Raises:
          ValueError: no run directory, a run of another trainer or of one learner, or no such checkpoint.
        """
        config = load_config(Path(run_dir))
        if not isinstance(config.trainer, PoseMapperConfig) or not config.env.arms.are_drawn:
            kind = f"trainer={config.trainer.name} env={config.env.name}"
            raise ValueError(
                f"{os.fspath(run_dir)!r}: expected a run of trainer=pose_mapper that draws its arms, as env=any_arm "
                f"does, got one of {kind}"
            )
        return cls.read(config, lambda template: load_checkpoint(Path(run_dir), template, checkpoint)[1])

    @classmethod
    def read(
        cls, config: TrainConfig, read_params: Callable[[Params], Params], report: Mapping[str, Any] | None = None
    ) -> "AnyArmMapper":
        """The mapper of a config.

        Args:
          config: of a run of trainer=pose_mapper that draws its arms.
          read_params: the parameters, from their shapes.
          report: see `AnyArmMapper`.
        """
        assert isinstance(config.trainer, PoseMapperConfig)
        env = config.env
        model = make_any_arm_model(env, config.trainer.resolve_any_arm())
        template = jax.eval_shape(model.init, jax.random.key(0))
        expert = build_arm(env.expert, env.limits, env.metric.links).embodiment
        return cls(model, read_params(template), expert, env, report or {})

    @functools.cached_property
    def _map(self):  # compiled once for each shape of the poses, whatever the learner is
        def of_pose(params: Params, qpos: Array, learner: ArmArrays) -> Array:
            return self.model(params, link_states(self.model.expert, qpos), learner)

        return jax.jit(jax.vmap(of_pose, (None, 0, None)))

    def __call__(
        self, qpos: Float[ArrayLike, "*batch joints"], learner: Learner
    ) -> Float[Array, "*batch learner_joints"]:
        """Maps poses of the expert to poses of a learner [rad].

        Args:
          qpos: [n] or [..., n] the expert's poses [rad].
          learner: arrays of one arm, an arm, its config, its name or file (see `ArmConfig.model`), or the name of an
            environment. `jax.vmap` takes many learners as arrays.

        Returns:
          The learner's poses [rad]: [n_hat] or [..., n_hat]; for arrays [..., 8], the slots of `ArmArrays`.

        Raises:
          ValueError: poses of the wrong shape, not finite, or outside of the expert's joint range; a learner that
            cannot be loaded, is a tree, or has too many joints or links.
        """
        poses = check_poses(self.expert, qpos)
        if isinstance(learner, ArmArrays):
            arrays, joints = self.arrays(learner), np.arange(MAX_JOINTS)
        else:
            described = self.describe(learner)
            arrays, joints = described.arrays, described.joints
        flat = padded_poses(poses.reshape(-1, self.expert.num_joints))
        learner_poses = self._map(self.params, flat, arrays)
        return learner_poses.reshape(*poses.shape[:-1], MAX_JOINTS)[..., joints]

    def arrays(self, learner: Learner) -> ArmArrays:
        """The description of a learner that the network takes, in single precision.

        Raises:
          ValueError: see `__call__`.
        """
        if not isinstance(learner, ArmArrays):
            return self.describe(learner).arrays
        expected = (MAX_JOINTS,), (MAX_LINKS,)
        got = jnp.shape(learner.home), jnp.shape(learner.link_length)
        if got != expected:
            raise ValueError(
                f"learner: expected arrays of one arm, home {list(expected[0])} and link_length {list(expected[1])}, "
                f"got {list(got[0])} and {list(got[1])}; use jax.vmap for many arms"
            )
        return jax.tree.map(_single, learner)

    def describe(self, learner: Arm | ArmConfig | str | os.PathLike[str]) -> "DescribedArm":
        """An arm and its arrays. Joints that a config locks are locked by the mask, as in training.

        Raises:
          ValueError: see `__call__`.
        """
        limits, links = self.env.limits, self.env.metric.links
        if isinstance(learner, Arm):
            return DescribedArm.without_locks(learner)
        if not isinstance(learner, ArmConfig):
            name = os.fspath(learner)
            learner = env_config(name).learner if name in environments() else ArmConfig(model=name)
        arm = build_arm(learner, limits, links)
        whole = build_arm(dataclasses.replace(learner, locked=None), limits, links) if arm.locked else arm
        if max(whole.embodiment.num_joints - MAX_JOINTS, whole.embodiment.num_links - MAX_LINKS) > 0:
            return DescribedArm.without_locks(arm)  # it may have few enough without those that are locked
        arrays, names = masked_arrays(learner, limits, links)
        is_free = np.asarray(arrays.is_free) > 0
        return DescribedArm(arm, arrays.astype(np.float32), np.flatnonzero(is_free), names)

    def to(self, learner: Arm | ArmConfig | str | os.PathLike[str]) -> PoseMapper:
        """The mapper to one learner, for everything that takes a `PoseMapper`.

        Raises:
          ValueError: see `__call__`.
        """
        return PoseMapper(
            OneLearnerModel(self.model, self.describe(learner), self.expert, self.env.metric), self.params
        )


@dataclasses.dataclass(frozen=True, eq=False)
class OneLearnerModel:
    """A mapper to any arm with a constant learner; the same functions as of `MapperModel`.

    Attributes:
      mapper: the mapper to any arm.
      described: the learner.
      expert: embodiment with n joints.
      metric: config of the metric.
    """

    mapper: AnyArmMapperModel
    described: DescribedArm
    expert: Embodiment
    metric: MetricConfig

    @property
    def learner(self) -> Embodiment:
        """Embodiment with n_hat joints."""
        return self.described.arm.embodiment

    def candidates(self, params: Params, qpos: Float[Array, " joints"]) -> Float[Array, "heads learner_joints"]:
        """The poses of the heads after the Newton steps [rad]."""
        expert = link_states(self.mapper.expert, padded_poses(qpos))
        return self.mapper.refined(params, expert, self.described.arrays)[0][:, self.described.joints]

    def distance(self, qpos: Float[Array, " joints"], learner_qpos: Float[Array, " learner_joints"]) -> Array:
        """Embodiment distance between a pose of the expert and a pose of the learner."""
        expert = link_states(self.mapper.expert, padded_poses(qpos))
        arrays, joints = self.described.arrays, self.described.joints
        return self.mapper.distance(expert, arrays, jnp.asarray(arrays.home).at[joints].set(learner_qpos))

    def __call__(self, params: Params, qpos: Float[Array, " joints"]) -> Float[Array, " learner_joints"]:
        """The nearest of the poses of the heads."""
        expert = link_states(self.mapper.expert, padded_poses(qpos))
        return self.mapper(params, expert, self.described.arrays)[self.described.joints]


def load_mapper(
    run_dir: str | os.PathLike[str], checkpoint: int | None = None, learner: ArmConfig | None = None
) -> PoseMapper:
    """The mapper of a run to one learner, whether the run trained for that one or for any arm.

    Args:
      run_dir: the run directory.
      checkpoint: number of training poses of the checkpoint; the last checkpoint where None.
      learner: arm to map to, where the run draws its arms; default: the learner of its environment.

    Raises:
      ValueError: see `PoseMapper.load` and `AnyArmMapper.load`.
    """
    env = load_config(Path(run_dir)).env
    if not env.arms.are_drawn:
        return PoseMapper.load(run_dir, checkpoint)
    return AnyArmMapper.load(run_dir, checkpoint).to(learner or env.learner)


def one_learner(env: EnvConfig) -> EnvConfig:
    """The environment with its own learner, which is one of those that it may draw."""
    return dataclasses.replace(env, arms=ArmsConfig())


def padded_poses(qpos: Float[Array, "*batch joints"]) -> Float[Array, "*batch 8"]:
    """Poses with 0 in the slots of joints that an arm does not have."""
    missing = MAX_JOINTS - qpos.shape[-1]
    return jnp.concatenate([qpos, jnp.zeros((*qpos.shape[:-1], missing), qpos.dtype)], axis=-1)


def _single(values: ArrayLike) -> Array:
    values = jnp.asarray(values)
    return values.astype(jnp.float32) if jnp.issubdtype(values.dtype, jnp.floating) else values
