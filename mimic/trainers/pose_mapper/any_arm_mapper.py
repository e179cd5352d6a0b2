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
from jax.core import Tracer
from jax.typing import ArrayLike
from jaxtyping import Array, Float

from mimic.arms.arm import Arm, ArmConfig, build_arm
from mimic.arms.arrays import MAX_JOINTS, MAX_LINKS, ArmArrays, masked_arrays
from mimic.arms.embodiment import Embodiment
from mimic.envs import env_config, environments
from mimic.envs.config import EnvConfig
from mimic.runs.checkpoints import load_checkpoint
from mimic.trainers.config import PoseMapperConfig, TrainConfig
from mimic.trainers.pose_mapper.any_arm_model import (
    AnyArmMapperModel,
    Params,
    expert_pose,
    make_any_arm_model,
)
from mimic.trainers.pose_mapper.model import PoseMapper, check_poses
from mimic.trainers.pose_mapper.one_pair import DescribedArm, OnePairModel
from mimic.trainers.run_config import load_config

OneArm = Arm | ArmConfig | str | os.PathLike[str]


@dataclasses.dataclass(frozen=True, eq=False)
class AnyArmMapper:
    """A trained mapper to any arm: call it with poses of the expert and a learner.

    Attributes:
      model: network, expert and metric.
      params: parameters of the network.
      own_expert: the environment's expert.
      env: config of the environment; learners that are no arrays are built with its `limits` and `metric.links`.
      report: of `mimic.load`: the metrics of these weights, as in report.json of a run, and where they come from.
    """

    model: AnyArmMapperModel
    params: Params
    own_expert: DescribedArm
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
        if not isinstance(config.trainer, PoseMapperConfig) or config.env.kind != "sampled_arms":
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
        model = make_any_arm_model(env, config.trainer)
        template = jax.eval_shape(model.init, jax.random.key(0))
        expert = DescribedArm.without_locks(build_arm(env.expert, env.limits, env.metric.links))
        return cls(model, read_params(template), expert, env, report or {})

    @property
    def expert(self) -> Embodiment:
        """The environment's expert: the arm of the input poses where no other one is named."""
        return self.own_expert.arm.embodiment

    @functools.cached_property
    def _map(self):  # compiled once for each shape of the poses, whatever the arms are
        def of_pose(params: Params, expert: ArmArrays, qpos: Array, learner: ArmArrays) -> Array:
            # XLA computes with a constant what it can while it compiles, which rounds otherwise than an argument does.
            arm = expert if self.model.expert_is_drawn else self.model.expert
            return self.model(params, expert_pose(arm, qpos), learner)

        return jax.jit(jax.vmap(of_pose, (None, None, 0, None)))

    def __call__(
        self,
        qpos: Float[ArrayLike, "*batch joints"],
        learner: ArmArrays | OneArm,
        expert: ArmArrays | OneArm | None = None,
    ) -> Float[Array, "*batch learner_joints"]:
        """Maps poses of an expert to poses of a learner [rad].

        Args:
          qpos: [n] or [..., n] the expert's poses [rad]; of an expert as arrays [..., 8], the slots of `ArmArrays`, of
            which those of joints that do not move are ignored.
          learner: arrays of one arm, an arm, its config, its name or file (see `ArmConfig.model`), or the name of an
            environment, whose learner it is. `jax.vmap` takes many learners as arrays.
          expert: another expert than the environment's, in the same ways; only of a mapper that was trained with
            `env.arms.expert=drawn`.

        Returns:
          The learner's poses [rad]: [n_hat] or [..., n_hat]; for arrays [..., 8], the slots of `ArmArrays`.

        Raises:
          ValueError: poses of the wrong shape, not finite, or (not of arrays) outside of the expert's joint range; an
            arm that cannot be loaded, is a tree, or has too many joints or links; another expert where the mapper has
            a fixed one.
        """
        if isinstance(expert, ArmArrays):
            self._check_takes_experts()
            expert_arrays = self.arrays(expert, "expert")
            poses = _checked_slots(expert_arrays, qpos)
        else:
            described = self.describe_expert(expert)
            expert_arrays = described.arrays
            poses = described.in_slots(check_poses(described.arm.embodiment, qpos))
        if isinstance(learner, ArmArrays):
            arrays, joints = self.arrays(learner), np.arange(MAX_JOINTS)
        else:
            described = self.describe(learner)
            arrays, joints = described.arrays, described.joints
        learner_poses = self._map(self.params, expert_arrays, poses.reshape(-1, MAX_JOINTS), arrays)
        return learner_poses.reshape(poses.shape)[..., joints]

    def arrays(self, arm: ArmArrays | OneArm, role: str = "learner") -> ArmArrays:
        """The description of an arm that the network takes, in single precision.

        Args:
          arm: see `__call__`.
          role: "learner" or "expert", for the error.

        Raises:
          ValueError: see `__call__`.
        """
        if not isinstance(arm, ArmArrays):
            return self.describe(arm).arrays
        expected = (MAX_JOINTS,), (MAX_LINKS,)
        got = jnp.shape(arm.home), jnp.shape(arm.link_length)
        if got != expected:
            raise ValueError(
                f"{role}: expected arrays of one arm, home {list(expected[0])} and link_length {list(expected[1])}, "
                f"got {list(got[0])} and {list(got[1])}; use jax.vmap for many arms"
            )
        return jax.tree.map(_single, arm)

    def describe(self, arm: OneArm) -> DescribedArm:
        """An arm and its arrays, see `describe_arm`."""
        return describe_arm(self.env, arm)

    def describe_expert(self, expert: OneArm | None) -> DescribedArm:
        """An expert and its arrays; the environment's where None.

        Raises:
          ValueError: see `__call__`.
        """
        if expert is None:
            return self.own_expert
        self._check_takes_experts()
        return self.describe(expert)

    def _check_takes_experts(self) -> None:
        if not self.model.expert_is_drawn:
            raise ValueError(
                f"expert: expected none, because this mapper has a fixed one, {self.expert.name}; train one for any "
                "expert with env.arms.expert=drawn"
            )

    def to(self, learner: OneArm, expert: OneArm | None = None) -> PoseMapper:
        """The mapper between two arms, for everything that takes a `PoseMapper`.

        Args:
          learner: see `__call__`.
          expert: see `__call__`.

        Raises:
          ValueError: see `__call__`.
        """
        arms = self.describe_expert(expert), self.describe(learner)
        return PoseMapper(OnePairModel(self.model, *arms, self.env.metric), self.params)


def describe_arm(env: EnvConfig, arm: OneArm) -> DescribedArm:
    """An arm and its arrays. Joints that a config locks are locked by the mask, as in training.

    Args:
      env: the environment, whose `limits` and `metric.links` the arm is built with.
      arm: the arm, see `AnyArmMapper.__call__`.

    Raises:
      ValueError: see `AnyArmMapper.__call__`.
    """
    limits, links = env.limits, env.metric.links
    if isinstance(arm, Arm):
        return DescribedArm.without_locks(arm)
    if isinstance(arm, ArmConfig):
        config = arm
    else:
        name = os.fspath(arm)
        config = env_config(name).learner if name in environments() else ArmConfig(model=name)
    built = build_arm(config, limits, links)
    whole = build_arm(dataclasses.replace(config, locked=None), limits, links) if built.locked else built
    if max(whole.embodiment.num_joints - MAX_JOINTS, whole.embodiment.num_links - MAX_LINKS) > 0:
        return DescribedArm.without_locks(built)  # it may have few enough without those that are locked
    arrays, names = masked_arrays(config, limits, links)
    is_free = np.asarray(arrays.is_free) > 0
    return DescribedArm(built, arrays.astype(np.float32), np.flatnonzero(is_free), names)


def load_mapper(
    run_dir: str | os.PathLike[str],
    checkpoint: int | None = None,
    learner: ArmConfig | None = None,
    expert: ArmConfig | None = None,
) -> PoseMapper:
    """The mapper of a run to one learner, whether the run trained for that one or for any arm.

    Args:
      run_dir: the run directory.
      checkpoint: number of training poses of the checkpoint; the last checkpoint where None.
      learner: arm to map to, where the run draws its learners; default: the learner of its environment.
      expert: arm of the poses, where the run draws its experts; default: the expert of its environment.

    Raises:
      ValueError: see `PoseMapper.load` and `AnyArmMapper.load`.
    """
    env = load_config(Path(run_dir)).env
    if env.arms is None:
        return PoseMapper.load(run_dir, checkpoint)
    return AnyArmMapper.load(run_dir, checkpoint).to(
        learner or env.learner, expert if env.arms.expert == "drawn" else None
    )


def one_learner(env: EnvConfig) -> EnvConfig:
    """The environment with its own learner, which is one of those that it may draw."""
    return dataclasses.replace(env, arms=None)


def _checked_slots(arm: ArmArrays, qpos: ArrayLike) -> Float[Array, "*batch 8"]:
    """Poses of an arm as arrays, at home in the slots of joints that do not move.

    Under `jax.jit` only the shape is checked.

    Raises:
      ValueError: poses of the wrong shape, or not finite.
    """
    poses = jnp.asarray(qpos, jnp.float32)
    if poses.shape[-1:] != (MAX_JOINTS,):
        raise ValueError(f"qpos: expected shape [..., {MAX_JOINTS}] for an expert as arrays, got {poses.shape}")
    if not isinstance(poses, Tracer) and not np.all(np.isfinite(np.asarray(poses))):
        raise ValueError("qpos: expected finite angles [rad], got some that are not")
    return jnp.where(jnp.asarray(arm.is_free) > 0, poses, arm.home)


def _single(values: ArrayLike) -> Array:
    values = jnp.asarray(values)
    return values.astype(jnp.float32) if jnp.issubdtype(values.dtype, jnp.floating) else values
