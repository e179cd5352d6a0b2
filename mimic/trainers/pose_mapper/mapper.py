"""A trained pose mapper: of one pair of arms, or of any arms, which are then arguments."""

import dataclasses
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

from mimic.arms.arrays import MAX_JOINTS, MAX_LINKS, ArmArrays
from mimic.arms.embodiment import Embodiment
from mimic.arms.pose_limits import pose_limits
from mimic.envs.config import EnvConfig
from mimic.retargeting.pose import checked_poses
from mimic.runs.checkpoints import load_checkpoint
from mimic.trainers.config import PoseMapperConfig, TrainConfig
from mimic.trainers.pose_mapper.mapper_arm import MapperArm, NamedArm, describe_arm
from mimic.trainers.pose_mapper.model import MapperModel, Params, make_model
from mimic.trainers.pose_mapper.pair import Target, at_home_where_locked
from mimic.trainers.run_config import load_config

_LIMIT_TOLERANCE = 1e-4  # rad: rounding to float32 moves a pose over its limit by less than this


@dataclasses.dataclass(frozen=True, eq=False)
class PoseMapper:
    """A trained mapper: call it with one pose of the expert or a batch of poses. Safe under `jax.jit` and `jax.vmap`.

    A mapper that was trained for any learner, as with env=any_arm, takes the learner as another argument, and one with
    `env.arms.expert=drawn` an expert too; `to` gives the mapper of one pair.

    Attributes:
      model: network, arms and metric.
      params: parameters of the network.
      expert_arm: the arm of the input poses; that of the environment where None.
      learner_arm: the arm of the output poses; that of the environment where None.
      report: of `mimic.load`: the metrics of these weights, as in report.json of a run, and where they come from.
    """

    model: MapperModel
    params: Params
    expert_arm: MapperArm | None = None
    learner_arm: MapperArm | None = None
    report: Mapping[str, Any] = dataclasses.field(default_factory=dict)

    @classmethod
    def load(cls, run_dir: str | os.PathLike[str], checkpoint: int | None = None) -> "PoseMapper":
        """Loads the mapper of a run of `python -m mimic.train trainer=pose_mapper`.

        Args:
          run_dir: the run directory.
          checkpoint: number of training poses of the checkpoint; the last checkpoint where None.

        Raises:
          ValueError: no run directory, a run of another trainer, or no such checkpoint.
        """
        config = load_config(Path(run_dir))
        if not isinstance(config.trainer, PoseMapperConfig):
            raise ValueError(
                f"{os.fspath(run_dir)!r}: expected a run of trainer=pose_mapper, got one of {config.trainer.name}"
            )
        return cls.read(config, lambda template: load_checkpoint(Path(run_dir), template, checkpoint)[1])

    @classmethod
    def read(
        cls, config: TrainConfig, read_params: Callable[[Params], Params], report: Mapping[str, Any] | None = None
    ) -> "PoseMapper":
        """The mapper of a run's config, with the parameters that a function reads of their shapes."""
        assert isinstance(config.trainer, PoseMapperConfig)
        model = make_model(config.env, config.trainer)
        return cls(model, read_params(jax.eval_shape(model.init, jax.random.key(0))), report=report or {})

    @property
    def env(self) -> EnvConfig:
        """The environment; learners by name are built with its `limits` and `metric.links`."""
        return self.model.env

    @property
    def takes_any_learner(self) -> bool:
        """Whether the learner is an argument."""
        return self.model.learner is None and self.learner_arm is None

    @property
    def expert(self) -> Embodiment:
        """The arm of the input poses where no other one is named."""
        return self._expert.embodiment

    @property
    def learner(self) -> Embodiment:
        """The arm of the output poses.

        Raises:
          ValueError: the mapper takes any learner.
        """
        return self._learner.embodiment

    @property
    def _expert(self) -> MapperArm:
        return self.expert_arm or self.model.expert

    @property
    def _learner(self) -> MapperArm:
        learner = self.learner_arm or self.model.learner
        if learner is None:
            raise ValueError(
                "learner: expected an arm, because this mapper takes any: mapper(qpos, LEARNER) or mapper.to(LEARNER)"
            )
        return learner

    def __call__(
        self,
        qpos: Float[ArrayLike, "*batch joints"],
        learner: ArmArrays | NamedArm | None = None,
        expert: ArmArrays | NamedArm | None = None,
    ) -> Float[Array, "*batch learner_joints"]:
        """Maps poses of the expert to poses of the learner [rad]. Compiled once for all arms of a mapper of any arms.

        Args:
          qpos: [n] or [..., n] the expert's poses [rad]; of an expert as arrays [..., 8], the slots of `ArmArrays`, of
            which those of joints that do not move are ignored.
          learner: of a mapper that takes any: arrays of one arm, an arm, its config, its name or file (see
            `ArmConfig.model`), or the name of an environment, whose learner it is. `jax.vmap` takes many learners as
            arrays.
          expert: another expert than the environment's, in the same ways; only of a mapper that was trained with
            `env.arms.expert=drawn`.

        Returns:
          The learner's poses [rad]: [n_hat] or [..., n_hat]; for arrays [..., 8], the slots of `ArmArrays`.

        Raises:
          ValueError: poses of the wrong shape, not finite, or (not of arrays) outside of the expert's joint range; an
            arm that cannot be loaded, is a tree, or has too many joints or links; no learner, or an arm that the mapper
            does not take.
        """
        from_arm = self._expert if expert is None else self._described(expert, "expert")
        to_arm = self._learner if learner is None else self._described(learner, "learner")
        poses = from_arm.in_slots(_checked(from_arm, qpos))
        flat = poses.reshape(-1, poses.shape[-1])
        arrays = (arm.data if isinstance(arm.data, ArmArrays) else None for arm in (to_arm, from_arm))
        learner_poses = to_arm.own_joints(self.model.of_poses(self.params, flat, *arrays))
        return learner_poses.reshape(*poses.shape[:-1], -1)

    def _target(self, qpos: Float[Array, " joints"]) -> Target:
        return self.model.pair(self._learner.data, self._expert.data).target(self._expert.in_slots(qpos))

    def candidates(self, qpos: Float[Array, " joints"]) -> Float[Array, "poses learner_joints"]:
        """The poses among which the mapper chooses the nearest [rad]; of one pose of the expert."""
        return self._learner.own_joints(self.model.improved(self.params, self._target(qpos)))

    def nearest(self, qpos: Float[Array, " joints"]) -> Float[Array, " learner_joints"]:
        """What a call returns for one pose of the expert [rad], without checks."""
        return self._learner.own_joints(self.model(self.params, self._target(qpos)))

    def distance(self, qpos: Float[Array, " joints"], learner_qpos: Float[Array, " learner_joints"]) -> Array:
        """Embodiment distance between a pose of the expert and a pose of the learner."""
        return self._target(qpos).distance(self._learner.in_slots(learner_qpos))

    def arrays(self, arm: ArmArrays | NamedArm) -> ArmArrays:
        """The description of an arm that the network takes, in single precision; see `__call__`."""
        return _one_arm(arm, "learner").data if isinstance(arm, ArmArrays) else describe_arm(self.env, arm).data

    def _described(self, arm: ArmArrays | NamedArm, role: str) -> MapperArm:
        takes_any = self.model.takes_any_expert if role == "expert" else self.model.learner is None
        if not takes_any:
            own = self.expert if role == "expert" else self.learner
            key = "env.arms.expert=drawn" if role == "expert" else "env=any_arm"
            raise ValueError(
                f"{role}: expected none, because this mapper has a fixed one, {own.name}; train one for any {role} "
                f"with {key}"
            )
        return _one_arm(arm, role) if isinstance(arm, ArmArrays) else describe_arm(self.env, arm)

    def to(self, learner: NamedArm, expert: NamedArm | None = None) -> "PoseMapper":
        """The mapper between two arms.

        Args:
          learner: see `__call__`.
          expert: see `__call__`.

        Raises:
          ValueError: see `__call__`.
        """
        expert_arm = self.expert_arm if expert is None else self._described(expert, "expert")
        return dataclasses.replace(self, expert_arm=expert_arm, learner_arm=self._described(learner, "learner"))

    def check_fits(self, expert: Embodiment, learner: Embodiment) -> None:
        """Raises a ValueError unless the mapper maps poses of this expert to poses of this learner."""
        for role, arm, own in (("expert", expert, self.expert), ("learner", learner, self.learner)):
            if (arm.name, arm.joint_names) != (own.name, own.joint_names):
                raise ValueError(
                    f"mapper: its {role} is {own.name} with joints {', '.join(own.joint_names)}, "
                    f"expected {arm.name} with joints {', '.join(arm.joint_names)}"
                )


AnyArmMapper = PoseMapper  # in `mimic.__all__`: a mapper that takes any learner


def load_mapper(
    run_dir: str | os.PathLike[str],
    checkpoint: int | None = None,
    learner: NamedArm | None = None,
    expert: NamedArm | None = None,
) -> PoseMapper:
    """The mapper of a run to one learner, whether the run trained for that one or for any arm.

    Args:
      run_dir: the run directory.
      checkpoint: number of training poses of the checkpoint; the last checkpoint where None.
      learner: arm to map to, where the run draws its learners; default: the learner of its environment.
      expert: arm of the poses, where the run draws its experts; default: the expert of its environment.

    Raises:
      ValueError: see `PoseMapper.load`.
    """
    mapper = PoseMapper.load(run_dir, checkpoint)
    if not mapper.takes_any_learner:
        return mapper
    return mapper.to(learner or mapper.env.learner, expert if mapper.model.takes_any_expert else None)


def _one_arm(arm: ArmArrays, role: str) -> MapperArm:
    """An arm as arrays in single precision, whose own joints are all slots.

    Raises:
      ValueError: arrays of many arms.
    """
    expected = (MAX_JOINTS,), (MAX_LINKS,)
    got = jnp.shape(arm.home), jnp.shape(arm.link_length)
    if got != expected:
        raise ValueError(
            f"{role}: expected arrays of one arm, home {list(expected[0])} and link_length {list(expected[1])}, "
            f"got {list(got[0])} and {list(got[1])}; use jax.vmap for many arms"
        )
    return MapperArm(None, jax.tree.map(_single, arm), np.arange(MAX_JOINTS), ())


def _single(values: ArrayLike) -> Array:
    values = jnp.asarray(values)
    return values.astype(jnp.float32) if jnp.issubdtype(values.dtype, jnp.floating) else values


def _checked(arm: MapperArm, qpos: ArrayLike) -> Array:
    """Poses of an arm's own joints as a floating point array. Under `jax.jit` only the shape is checked.

    Raises:
      ValueError: poses of the wrong shape, not finite, or (not of an arm as arrays alone) outside of the joint range.
    """
    if arm.embodiment is not None:
        poses = checked_poses(arm.embodiment, jnp.asarray(qpos))
        if not isinstance(poses, Tracer):
            _check_range(arm.embodiment, np.asarray(poses))
        return poses
    poses = jnp.asarray(qpos, jnp.float32)
    if poses.shape[-1:] != (MAX_JOINTS,):
        raise ValueError(f"qpos: expected shape [..., {MAX_JOINTS}] for an expert as arrays, got {poses.shape}")
    if not isinstance(poses, Tracer) and not np.all(np.isfinite(np.asarray(poses))):
        raise ValueError("qpos: expected finite angles [rad], got some that are not")
    return at_home_where_locked(arm.data, poses)


def _check_range(arm: Embodiment, poses: np.ndarray) -> None:
    lower, upper = pose_limits(arm, poses.dtype)
    outside = (poses < lower - _LIMIT_TOLERANCE) | (poses > upper + _LIMIT_TOLERANCE)
    if outside.any():
        *_, joint = first = tuple(np.argwhere(outside)[0])
        raise ValueError(
            f"qpos: {arm.joint_names[joint]} at {poses[first]:.4f} rad is outside of its range "
            f"[{lower[joint]:.4f}, {upper[joint]:.4f}]"
        )
