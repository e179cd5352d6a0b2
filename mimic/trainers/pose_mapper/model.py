"""The pose mapper: a network that maps a pose of the expert to the nearest pose of the learner (paper, eq. 23)."""

import dataclasses
import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import linen as nn
from jaxtyping import Array, Float

from mimic.arms.arm import build_arm
from mimic.arms.arrays import MAX_JOINTS, MAX_LINKS, ArmArrays
from mimic.arms.embodiment import Embodiment
from mimic.base.compilation import on_host
from mimic.envs.config import EnvConfig
from mimic.metric.config import check_metric
from mimic.metric.distance import DistanceWeights
from mimic.trainers.config import PoseMapperConfig
from mimic.trainers.pose_mapper.mapper_arm import MapperArm
from mimic.trainers.pose_mapper.networks import FullyConnected, JointTokens
from mimic.trainers.pose_mapper.pair import Arm, Pair, Poses, Target, poses_within_range

Params = Any


@dataclasses.dataclass(frozen=True, eq=False)
class MapperModel:
    """A mapper without its parameters: pure functions of one pose; batch with `jax.vmap`.

    Attributes:
      env: its metric defines the nearest pose, and chooses among those that the network proposes.
      config: settings of the network.
      expert: the environment's expert.
      learner: the learner; None for any learner, whose description is then an input of the network.
    """

    env: EnvConfig
    config: PoseMapperConfig
    expert: MapperArm
    learner: MapperArm | None

    @property
    def takes_any_expert(self) -> bool:
        """Whether the expert may be any arm too."""
        return self.learner is None and self.env.arms is not None and self.env.arms.expert == "drawn"

    @property
    def embodiments(self) -> tuple[Embodiment, Embodiment]:
        """Expert and learner of a mapper that has one pair."""
        assert self.learner is not None
        return self.expert.embodiment, self.learner.embodiment

    @property
    def starts(self) -> int:
        """Number of poses from which it takes Newton steps."""
        return self.config.heads + (self.config.guesses or 0)

    @functools.cached_property
    def weights(self) -> DistanceWeights:
        """The metric's weights, where the learner may be any arm."""
        return check_metric(self.env.metric)

    @functools.cached_property
    def _own_pair(self) -> Pair:
        assert self.learner is not None
        # A cached value must not be a tracer of the first function that is traced with it. On the host because the
        # first computation on a GPU takes seconds to start.
        with jax.ensure_compile_time_eval(), on_host():
            metric = self.env.metric.build(self.expert.embodiment, self.learner.embodiment)
            if not callable(metric.correspondence):
                metric = dataclasses.replace(metric, correspondence=np.asarray(metric.correspondence))
            return Pair(self.expert.data, self.learner.data, metric)

    def pair(self, learner: Arm | None = None, expert: Arm | None = None) -> Pair:
        """The arms of a mapping: the model's own ones, or any learner and, where the model takes any, any expert."""
        if self.learner is not None:
            return self._own_pair
        # XLA computes with a constant what it can while it compiles, which rounds otherwise than an argument does.
        expert = expert if self.takes_any_expert and expert is not None else self.expert.data
        assert isinstance(expert, ArmArrays) and isinstance(learner, ArmArrays)
        return Pair.of_arrays(expert, learner, self.weights)

    @functools.cached_property
    def _network(self) -> nn.Module:
        config = self.config
        if self.learner is not None:
            return FullyConnected(config.heads, tuple(config.hidden_layers), config.activation, config.inputs)
        links = MAX_LINKS if self.takes_any_expert else self.expert.embodiment.num_links
        return JointTokens(config.heads, config.width, config.layers, links)

    def init(self, key: Array) -> Params:
        """Random parameters."""
        target = self.pair(self.expert.data).target(jnp.zeros(len(self.expert.data.joint_range)))
        return self._network.init(key, target)

    def candidates(self, params: Params, target: Target) -> Poses:
        """The poses that the heads propose [rad]; locked joints stay at home.

        Args:
          params: parameters of the network.
          target: the arms, with the expert in its pose.
        """
        outputs: Any = self._network.apply(params, target)
        return poses_within_range(target.pair.learner, outputs, on_circle=self.config.outputs != "tanh")

    def initial_poses(self, params: Params, target: Target) -> Poses:
        """The poses of the heads, then `guesses` that do not depend on the expert [rad]."""
        proposed, learner = self.candidates(params, target), target.pair.learner
        if not self.config.guesses:
            return proposed
        assert isinstance(learner, ArmArrays)
        lower, upper = learner.joint_range[:, 0], learner.joint_range[:, 1]
        guesses = lower + _spread(self.config.guesses) * (upper - lower)
        return jnp.concatenate([proposed, jnp.where(learner.is_free > 0, guesses, learner.home)])

    def improved(self, params: Params, target: Target) -> Poses:
        """The initial poses after the Newton steps [rad]."""
        poses = self.initial_poses(params, target)
        return target.improved(poses, self.config.refinements) if self.config.refinements else poses

    def __call__(self, params: Params, target: Target) -> Float[Array, " learner_joints"]:
        """The nearest of the poses after the Newton steps [rad]."""
        poses = self.improved(params, target)
        return poses[0] if len(poses) == 1 else target.nearest(poses)[1]

    @functools.cached_property
    def of_poses(self) -> Callable[..., Float[Array, "poses learner_joints"]]:
        """(parameters, poses of the expert, learner, expert) -> poses [rad], compiled once whatever the arms are.

        The arms are arrays, or None where the mapper has its own ones.
        """

        def of_pose(params: Params, qpos: Array, learner: Any, expert: Any) -> Array:
            return self(params, self.pair(learner, expert).target(qpos))

        return jax.jit(jax.vmap(of_pose, (None, 0, None, None)))


def make_model(env: EnvConfig, config: PoseMapperConfig) -> MapperModel:
    """The untrained mapper of an environment's arms and metric.

    Raises:
      ValueError: arms that cannot be loaded; where the learner is drawn, an expert that has no arrays, or a metric
        other than of constant weights.
    """
    if env.kind != "sampled_arms":
        return MapperModel(env, config, *(MapperArm.constant(arm) for arm in env.build_arms().embodiments))
    model = MapperModel(env, config, MapperArm.without_locks(build_arm(env.expert, env.limits, env.metric.links)), None)
    _ = model.weights
    return model


def _spread(count: int) -> Float[np.ndarray, "count joints"]:
    """Points that fill the unit cube evenly: the additive recurrence of M. Roberts (2018), which never changes."""
    root = 2.0
    for _ in range(64):
        root = (1 + root) ** (1 / (MAX_JOINTS + 1))  # solves x^(joints + 1) = x + 1
    steps = root ** -np.arange(1.0, MAX_JOINTS + 1)
    return ((0.5 + np.outer(np.arange(1, count + 1), steps)) % 1).astype(np.float32)
