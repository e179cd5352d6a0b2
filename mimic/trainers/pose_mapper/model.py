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

from mimic.arms.embodiment import Embodiment
from mimic.arms.pose_limits import continuous_joints
from mimic.base.compilation import on_host
from mimic.envs.config import EnvConfig
from mimic.metric.distance import Metric
from mimic.metric.kinematics import LinkStates, link_states
from mimic.retargeting.pose import wrap_angles
from mimic.trainers.config import PoseMapperConfig

Params = Any
Poses = Float[Array, "poses learner_joints"]
_ACTIVATIONS = {"leaky_relu": nn.leaky_relu, "gelu": nn.gelu}


class _Network(nn.Module):
    """A fully connected network; arguments as of `PoseMapperConfig`, and the learner's number of joints."""

    heads: int
    joints: int
    hidden_layers: tuple[int, ...]
    activation: str

    @nn.compact
    def __call__(self, x: Float[Array, " inputs"]) -> Float[Array, "heads joints 2"]:
        """Two numbers for each joint of each head, see `MapperModel.candidates`."""
        for width in self.hidden_layers:
            x = _ACTIVATIONS[self.activation](nn.Dense(width)(x))
        return jnp.reshape(nn.Dense(self.heads * self.joints * 2)(x), (self.heads, self.joints, 2))


@dataclasses.dataclass(frozen=True, eq=False)
class MapperModel:
    """A mapper without its parameters: pure functions of one pose of the expert [rad]; batch with `jax.vmap`.

    Attributes:
      env: its metric defines the nearest pose, and chooses among those that the network proposes.
      config: settings of the network.
      expert: n joints.
      learner: n_hat joints.
    """

    env: EnvConfig
    config: PoseMapperConfig
    expert: Embodiment
    learner: Embodiment

    @functools.cached_property
    def metric(self) -> Metric:
        """The metric between the two arms."""
        # A cached value must not be a tracer of the first function that is traced with it. On the host because the
        # first computation on a GPU takes seconds to start.
        with jax.ensure_compile_time_eval(), on_host():
            metric = self.env.metric.build(self.expert, self.learner)
            if not callable(metric.correspondence):
                metric = dataclasses.replace(metric, correspondence=np.asarray(metric.correspondence))
            return metric

    @property
    def _network(self) -> nn.Module:
        config = self.config
        return _Network(config.heads, self.learner.num_joints, tuple(config.hidden_layers), config.activation)

    def init(self, key: Array) -> Params:
        """Random parameters."""
        return self._network.init(key, self._inputs(jnp.zeros(self.expert.num_joints)))

    def _inputs(self, qpos: Float[Array, " joints"]) -> Float[Array, " inputs"]:
        if self.config.inputs == "link_states":
            return self._link_inputs(link_states(self.expert, qpos))
        lower, upper = (jnp.asarray(bound, qpos.dtype) for bound in np.asarray(self.expert.joint_range).T)
        return (2 * wrap_angles(qpos, continuous_joints(self.expert)) - lower - upper) / (upper - lower)

    def _link_inputs(self, states: LinkStates) -> Array:
        assert states.direction is not None
        has_hand = not self.metric.hand_weights.are_zero
        parts = [states.position, states.direction, *([states.hand.axes] if has_hand and states.hand else [])]
        return jnp.concatenate([part.ravel() for part in parts])

    def candidates(self, params: Params, qpos: Float[Array, " joints"]) -> Poses:
        """The poses that the heads propose [rad].

        Of two numbers for each joint the first one suffices for joints with limits. With the output "circle" they are a
        point whose direction is the angle of a joint that rotates by a full revolution, continuous in them at pi.
        """
        outputs: Any = self._network.apply(params, self._inputs(qpos))
        lower, upper = (jnp.asarray(bound, outputs.dtype) for bound in np.asarray(self.learner.joint_range).T)
        poses = (lower + upper) / 2 + (upper - lower) / 2 * jnp.tanh(outputs[..., 0])
        if self.config.outputs == "tanh":
            return poses
        return jnp.where(continuous_joints(self.learner), jnp.arctan2(outputs[..., 1], outputs[..., 0]), poses)

    def distances(self, qpos: Float[Array, " joints"], poses: Poses) -> Float[Array, " poses"]:
        """Embodiment distances between a pose of the expert and poses of the learner [rad], at rest."""
        states = link_states(self.expert, qpos)
        return jax.vmap(lambda pose: self.metric(states, link_states(self.learner, pose)))(poses)

    def distance(self, qpos: Float[Array, " joints"], learner_qpos: Float[Array, " learner_joints"]) -> Array:
        """Embodiment distance between a pose of the expert and one of the learner [rad], at rest."""
        return self.metric(link_states(self.expert, qpos), link_states(self.learner, learner_qpos))

    def __call__(self, params: Params, qpos: Float[Array, " joints"]) -> Float[Array, " learner_joints"]:
        """The nearest of the poses that the heads propose [rad]."""
        poses = self.candidates(params, qpos)
        return poses[0] if len(poses) == 1 else poses[jnp.argmin(self.distances(qpos, poses))]

    @functools.cached_property
    def of_poses(self) -> Callable[[Params, Float[Array, "poses joints"]], Poses]:
        """(parameters, poses of the expert) -> poses [rad], compiled once for each number of poses."""
        return jax.jit(jax.vmap(self, (None, 0)))


def make_model(env: EnvConfig, config: PoseMapperConfig) -> MapperModel:
    """The untrained mapper of an environment's arms and metric.

    Raises:
      ValueError: arms that cannot be loaded.
    """
    return MapperModel(env, config, *env.build_arms().embodiments)


def random_poses(arm: Embodiment, key: Array, count: int) -> Float[Array, "count joints"]:
    """Poses [rad], uniform within the joints' ranges."""
    lower, upper = jnp.asarray(arm.joint_range, jnp.float32).T
    return jax.random.uniform(key, (count, len(lower)), jnp.float32, minval=lower, maxval=upper)
