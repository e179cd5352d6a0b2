"""The pose mapper: a network that maps a pose of the expert to the nearest pose of the learner (paper, eq. 23)."""

import dataclasses
import functools
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import linen as nn
from jax.core import Tracer
from jax.typing import ArrayLike
from jaxtyping import Array, Float

from mimic.arms.embodiment import Embodiment
from mimic.arms.pose_limits import continuous_joints, pose_limits
from mimic.base.compilation import on_host
from mimic.envs.config import EnvConfig
from mimic.metric.config import MetricConfig
from mimic.metric.distance import Metric
from mimic.metric.kinematics import link_states
from mimic.retargeting.pose import checked_poses, wrap_angles
from mimic.runs.checkpoints import load_checkpoint
from mimic.trainers.config import PoseMapperConfig
from mimic.trainers.pose_mapper.one_pair import OnePairModel
from mimic.trainers.run_config import load_config

Params = Any
PoseDistance = Callable[[Array, Array], Array]  # (expert's pose, learner's pose) -> distance

_ACTIVATIONS = {"leaky_relu": nn.leaky_relu, "gelu": nn.gelu}
_LIMIT_TOLERANCE = 1e-4  # rad: rounding to float32 moves a pose over its limit by less than this


class _Network(nn.Module):
    """A fully connected network."""

    hidden_layers: tuple[int, ...]
    outputs: int
    activation: str

    @nn.compact
    def __call__(self, x: Array) -> Array:
        for width in self.hidden_layers:
            x = _ACTIVATIONS[self.activation](nn.Dense(width)(x))
        return nn.Dense(self.outputs)(x)


@dataclasses.dataclass(frozen=True, eq=False)
class MapperModel:
    """A mapper without its parameters: pure functions of one pose.

    Attributes:
      expert: embodiment with n joints.
      learner: embodiment with n_hat joints.
      metric: config of the metric that defines the nearest pose and chooses among the heads.
      config: settings of the network.
    """

    expert: Embodiment
    learner: Embodiment
    metric: MetricConfig
    config: PoseMapperConfig

    @functools.cached_property
    def _network(self) -> _Network:
        outputs = self.config.heads * self.learner.num_joints * 2
        hidden_layers, activation = tuple(self.config.hidden_layers), self.config.activation
        return _Network(hidden_layers, outputs, activation)

    @functools.cached_property
    def built_metric(self) -> Metric:
        """The metric between the two arms."""
        # A cached value must not be a tracer of the first function that is traced with it. On the host because the
        # first computation on a GPU takes seconds to start.
        with jax.ensure_compile_time_eval(), on_host():
            metric = self.metric.build(self.expert, self.learner)
            matrix = metric.correspondence
            return metric if callable(matrix) else dataclasses.replace(metric, correspondence=np.asarray(matrix))

    @property
    def distance(self) -> PoseDistance:
        """Embodiment distance between a pose of the expert and a pose of the learner."""
        metric = self.built_metric
        return lambda qpos, learner_qpos: metric(
            link_states(self.expert, qpos), link_states(self.learner, learner_qpos)
        )

    def init(self, key: Array) -> Params:
        """Random parameters."""
        return self._network.init(key, self._inputs(jnp.zeros(self.expert.num_joints)))

    def candidates(self, params: Params, qpos: Float[Array, " joints"]) -> Float[Array, "heads learner_joints"]:
        """The poses that the heads propose.

        Args:
          params: parameters of the network.
          qpos: the expert's pose [rad].
        """
        config = self.config
        outputs = self._network.apply(params, self._inputs(qpos))
        outputs = jnp.reshape(outputs, (config.heads, self.learner.num_joints, 2))  # type: ignore[arg-type] - flax annotates all that apply may return
        lower, upper = (jnp.asarray(bound, qpos.dtype) for bound in np.asarray(self.learner.joint_range).T)
        within = (lower + upper) / 2 + (upper - lower) / 2 * jnp.tanh(outputs[..., 0])
        if config.outputs == "tanh":
            return within
        on_circle = jnp.arctan2(outputs[..., 1], outputs[..., 0])  # continuous in the outputs at pi
        return jnp.where(continuous_joints(self.learner), on_circle, within)

    def __call__(self, params: Params, qpos: Float[Array, " joints"]) -> Float[Array, " learner_joints"]:
        """The nearest of the poses that the heads propose."""
        candidates = self.candidates(params, qpos)
        if self.config.heads == 1:
            return candidates[0]
        distances = jax.vmap(lambda candidate: self.distance(qpos, candidate))(candidates)
        return candidates[jnp.argmin(distances)]

    def _inputs(self, qpos: Array) -> Array:
        if self.config.inputs == "link_states":
            states = link_states(self.expert, qpos)
            assert states.direction is not None
            return jnp.concatenate([states.position.ravel(), states.direction.ravel()])
        lower, upper = (jnp.asarray(bound, qpos.dtype) for bound in np.asarray(self.expert.joint_range).T)
        qpos = wrap_angles(qpos, continuous_joints(self.expert))
        return (2 * qpos - lower - upper) / (upper - lower)


@dataclasses.dataclass(frozen=True, eq=False)
class PoseMapper:
    """A trained mapper: call it with one pose of the expert or a batch of poses. Safe under `jax.jit` and `jax.vmap`.

    Attributes:
      model: network, arms and metric.
      params: parameters of the network.
    """

    model: MapperModel | OnePairModel
    params: Params

    @classmethod
    def load(cls, run_dir: str | os.PathLike[str], checkpoint: int | None = None) -> "PoseMapper":
        """Loads the mapper of a run of `python -m mimic.train trainer=pose_mapper`.

        Args:
          run_dir: the run directory.
          checkpoint: number of training poses of the checkpoint; the last checkpoint where None.

        Raises:
          ValueError: no run directory, a run of another trainer or of any arm, or no such checkpoint.
        """
        config = load_config(Path(run_dir))
        if not isinstance(config.trainer, PoseMapperConfig):
            raise ValueError(
                f"{os.fspath(run_dir)!r}: expected a run of trainer=pose_mapper, got one of {config.trainer.name}"
            )
        if config.env.kind == "sampled_arms":
            raise ValueError(
                f"{os.fspath(run_dir)!r}: expected a run with one learner, got env={config.env.name}; load it with "
                "mimic.AnyArmMapper.load(RUN_DIR).to(LEARNER)"
            )
        model = make_model(config.env, config.trainer)
        template = jax.eval_shape(model.init, jax.random.key(0))
        return cls(model, load_checkpoint(Path(run_dir), template, checkpoint)[1])

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
          [n_hat] or [..., n_hat] the learner's poses [rad].

        Raises:
          ValueError: poses of the wrong shape, not finite, or outside of the expert's joint range.
        """
        poses = check_poses(self.expert, qpos)
        flat = poses.reshape(-1, self.expert.num_joints)
        learner_poses = jax.vmap(functools.partial(self.model, self.params))(flat)
        return learner_poses.reshape(*poses.shape[:-1], self.learner.num_joints)

    def check_fits(self, expert: Embodiment, learner: Embodiment) -> None:
        """Raises a ValueError unless the mapper maps poses of this expert to poses of this learner."""
        for role, arm, own in (("expert", expert, self.expert), ("learner", learner, self.learner)):
            if (arm.name, arm.joint_names) != (own.name, own.joint_names):
                raise ValueError(
                    f"mapper: its {role} is {own.name} with joints {', '.join(own.joint_names)}, "
                    f"expected {arm.name} with joints {', '.join(arm.joint_names)}"
                )


def make_model(env: EnvConfig, config: PoseMapperConfig) -> MapperModel:
    """The untrained mapper of an environment's arms and metric.

    Raises:
      ValueError: arms that cannot be loaded.
    """
    return MapperModel(*env.build_arms().embodiments, env.metric, config)


def check_poses(arm: Embodiment, qpos: ArrayLike) -> Array:
    """Returns poses as a floating point array. Under `jax.jit` only the shape is checked.

    Raises:
      ValueError: poses of the wrong shape, not finite, or outside of the arm's joint range.
    """
    poses = checked_poses(arm, jnp.asarray(qpos))
    if isinstance(poses, Tracer):
        return poses
    values = np.asarray(poses)
    lower, upper = pose_limits(arm, values.dtype)
    outside = (values < lower - _LIMIT_TOLERANCE) | (values > upper + _LIMIT_TOLERANCE)
    if outside.any():
        *_, joint = first = tuple(np.argwhere(outside)[0])
        raise ValueError(
            f"qpos: {arm.joint_names[joint]} at {values[first]:.4f} rad is outside of its range "
            f"[{lower[joint]:.4f}, {upper[joint]:.4f}]"
        )
    return poses
