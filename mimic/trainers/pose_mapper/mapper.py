"""A trained pose mapper."""

import dataclasses
import os
from collections.abc import Callable
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jax.typing import ArrayLike
from jaxtyping import Array, Float

from mimic.arms.embodiment import Embodiment
from mimic.arms.pose_limits import pose_limits
from mimic.envs.config import EnvConfig
from mimic.retargeting.pose import checked_poses
from mimic.runs.checkpoints import load_checkpoint
from mimic.trainers.config import PoseMapperConfig, TrainConfig
from mimic.trainers.pose_mapper.model import MapperModel, Params, make_model
from mimic.trainers.run_config import load_config

_LIMIT_TOLERANCE = 1e-4  # rad: rounding to float32 moves a pose over its limit by less than this


@dataclasses.dataclass(frozen=True, eq=False)
class PoseMapper:
    """A trained mapper: call it with one pose of the expert or a batch of poses. Safe under `jax.jit` and `jax.vmap`.

    Attributes:
      model: network, arms and metric.
      params: parameters of the network.
    """

    model: MapperModel
    params: Params

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
    def read(cls, config: TrainConfig, read_params: Callable[[Params], Params]) -> "PoseMapper":
        """The mapper of a run's config, with the parameters that a function reads of their shapes."""
        assert isinstance(config.trainer, PoseMapperConfig)
        model = make_model(config.env, config.trainer)
        return cls(model, read_params(jax.eval_shape(model.init, jax.random.key(0))))

    @property
    def env(self) -> EnvConfig:
        """The environment of the training."""
        return self.model.env

    @property
    def expert(self) -> Embodiment:
        """The arm of the input poses."""
        return self.model.expert

    @property
    def learner(self) -> Embodiment:
        """The arm of the output poses."""
        return self.model.learner

    def __call__(self, qpos: Float[ArrayLike, "*batch joints"]) -> Float[Array, "*batch learner_joints"]:
        """Maps poses of the expert to poses of the learner [rad].

        Args:
          qpos: [n] or [..., n] the expert's poses [rad].

        Returns:
          The learner's poses [rad]: [n_hat] or [..., n_hat].

        Raises:
          ValueError: poses of the wrong shape, not finite, or outside of the expert's joint range.
        """
        poses = jnp.asarray(checked_poses(self.expert, qpos))
        if not isinstance(poses, Tracer):
            _check_range(self.expert, np.asarray(poses))
        learner_poses = self.model.of_poses(self.params, poses.reshape(-1, poses.shape[-1]))
        return learner_poses.reshape(*poses.shape[:-1], -1)

    def candidates(self, qpos: Float[Array, " joints"]) -> Float[Array, "poses learner_joints"]:
        """The poses among which the mapper chooses the nearest [rad]; of one pose of the expert."""
        return self.model.candidates(self.params, qpos)

    def distance(self, qpos: Float[Array, " joints"], learner_qpos: Float[Array, " learner_joints"]) -> Array:
        """Embodiment distance between a pose of the expert and a pose of the learner."""
        return self.model.distance(qpos, learner_qpos)

    def check_fits(self, expert: Embodiment, learner: Embodiment) -> None:
        """Raises a ValueError unless the mapper maps poses of this expert to poses of this learner."""
        for role, arm, own in (("expert", expert, self.expert), ("learner", learner, self.learner)):
            if (arm.name, arm.joint_names) != (own.name, own.joint_names):
                raise ValueError(
                    f"mapper: its {role} is {own.name} with joints {', '.join(own.joint_names)}, "
                    f"expected {arm.name} with joints {', '.join(arm.joint_names)}"
                )


def _check_range(arm: Embodiment, poses: np.ndarray) -> None:
    lower, upper = pose_limits(arm, poses.dtype)
    outside = (poses < lower - _LIMIT_TOLERANCE) | (poses > upper + _LIMIT_TOLERANCE)
    if outside.any():
        *_, joint = first = tuple(np.argwhere(outside)[0])
        raise ValueError(
            f"qpos: {arm.joint_names[joint]} at {poses[first]:.4f} rad is outside of its range "
            f"[{lower[joint]:.4f}, {upper[joint]:.4f}]"
        )
