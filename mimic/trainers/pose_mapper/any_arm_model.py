"""The pose mapper of any arm: one network from a pose of the expert and the description of a learner to its pose."""

import dataclasses
import functools
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from flax import linen as nn
from jaxtyping import Array, Float

from mimic.arms.arm import build_arm
from mimic.arms.arrays import MAX_JOINTS, MAX_LINKS, ArmArrays, arm_arrays
from mimic.envs.config import EnvConfig
from mimic.envs.family import arms_config
from mimic.metric.config import check_metric
from mimic.metric.correspondence import arc_length_correspondence
from mimic.metric.distance import DistanceWeights, Metric
from mimic.metric.kinematics import LinkStates, axes_and_origins, frame_table, link_states, states_in_frames
from mimic.retargeting.array_nearest import angle_limits, nearest_pose
from mimic.trainers.config import PoseMapperConfig
from mimic.trainers.networks import Transformer

Params = Any


class ExpertPose(NamedTuple):
    """An expert in a pose.

    Attributes:
      arm: the expert.
      states: its link states at rest.
    """

    arm: ArmArrays
    states: LinkStates


def expert_pose(arm: ArmArrays, qpos: Float[Array, " joints"]) -> ExpertPose:
    """An expert in the pose `qpos` [rad], which has an angle for each slot of a joint."""
    return ExpertPose(arm, link_states(arm, qpos))


class _Network(nn.Module):
    """Tokens of the learner's joints and links and of the expert's links -> numbers of each joint for each head."""

    width: int
    layers: int
    heads: int

    @nn.compact
    def __call__(
        self, joints: Array, links: Array, expert: Array, is_free: Array, has_link: Array, has_expert_link: Array
    ) -> Array:
        groups = []
        for name, group in (("joints", joints), ("links", links), ("expert", expert)):
            place = self.param(f"{name}_place", nn.initializers.normal(0.1), (group.shape[-2], self.width))
            groups.append(nn.Dense(self.width, name=name)(group) + place)
        present = jnp.concatenate([is_free, has_link, has_expert_link], axis=-1) > 0
        tokens = Transformer(self.width, self.layers)(jnp.concatenate(groups, axis=-2), present)
        outputs = nn.Dense(2 * self.heads, name="outputs")(tokens[..., :MAX_JOINTS, :])
        return jnp.moveaxis(outputs.reshape(*outputs.shape[:-1], self.heads, 2), -2, -3)


@dataclasses.dataclass(frozen=True, eq=False)
class AnyArmMapperModel:
    """A mapper without its parameters: pure functions of an expert's pose and a learner; batch with `jax.vmap`.

    Attributes:
      expert: the arm that is imitated, as NumPy arrays; where experts are drawn, one of them.
      expert_is_drawn: whether the network takes any expert. If not, it has a token for each of the expert's links;
        if so, one for each slot of a link.
      weights: of the metric.
      width: of the network's tokens.
      layers: of its transformer.
      heads: number of poses that it proposes.
      guesses: number of constant poses beside them, spread over the joints' ranges: all proposals may be near one
        minimum.
      refinements: Newton steps from each of these poses.
    """

    expert: ArmArrays
    expert_is_drawn: bool
    weights: DistanceWeights
    width: int
    layers: int
    heads: int
    guesses: int
    refinements: int

    @property
    def starts(self) -> int:
        """Number of poses from which it takes Newton steps."""
        return self.heads + self.guesses

    @functools.cached_property
    def _network(self) -> _Network:
        return _Network(self.width, self.layers, self.heads)

    @functools.cached_property
    def _expert_tokens(self) -> int:
        return MAX_LINKS if self.expert_is_drawn else int(np.count_nonzero(self.expert.link_length))

    def init(self, key: Array) -> Params:
        """Random parameters."""
        expert = expert_pose(self.expert, jnp.zeros(MAX_JOINTS))
        return self._network.init(key, *self._tokens(expert, self.expert))

    def candidates(self, params: Params, expert: ExpertPose, learner: ArmArrays) -> Float[Array, "heads joints"]:
        """The poses that the heads propose [rad]; locked joints stay at home.

        Args:
          params: parameters of the network.
          expert: the expert in its pose.
          learner: the learner.
        """
        outputs = self._network.apply(params, *self._tokens(expert, learner))
        assert isinstance(outputs, Array)
        lower, upper = learner.joint_range[:, 0], learner.joint_range[:, 1]
        within = (lower + upper) / 2 + (upper - lower) / 2 * jnp.tanh(outputs[..., 0])
        on_circle = learner.home + jnp.arctan2(outputs[..., 1], outputs[..., 0])
        poses = jnp.where(jnp.isinf(angle_limits(learner)[0]), on_circle, within)
        return jnp.where(learner.is_free > 0, poses, learner.home)

    def distance(self, expert: ExpertPose, learner: ArmArrays, qpos: Float[Array, " joints"]) -> Float[Array, ""]:
        """Embodiment distance between the expert's pose and a learner's, both at rest."""
        metric = Metric(arc_length_correspondence(expert.arm, learner), self.weights)
        return metric(expert.states, link_states(learner, qpos))

    def distances(self, expert: ExpertPose, learner: ArmArrays, poses: Float[Array, "n joints"]) -> Float[Array, " n"]:
        """Embodiment distances between the expert's pose and some of a learner's."""
        return jax.vmap(lambda qpos: self.distance(expert, learner, qpos))(poses)

    def initial_poses(self, params: Params, expert: ExpertPose, learner: ArmArrays) -> Float[Array, "starts joints"]:
        """Where the Newton steps start [rad]: the poses of the heads, then those that do not depend on the expert."""
        lower, upper = learner.joint_range[:, 0], learner.joint_range[:, 1]
        guesses = jnp.where(learner.is_free > 0, lower + _spread(self.guesses) * (upper - lower), learner.home)
        return jnp.concatenate([self.candidates(params, expert, learner), guesses])

    def refined(
        self, params: Params, expert: ExpertPose, learner: ArmArrays
    ) -> tuple[Float[Array, "starts joints"], Float[Array, " starts"]]:
        """The initial poses after the Newton steps, and their distances."""
        matrix = arc_length_correspondence(expert.arm, learner)

        def refine(qpos: Array) -> Array:
            return nearest_pose(learner, self.weights, matrix, expert.states, qpos, self.refinements).qpos

        poses = self.initial_poses(params, expert, learner)
        if self.refinements:
            poses = jax.vmap(refine)(poses)
        return poses, self.distances(expert, learner, poses)

    def __call__(self, params: Params, expert: ExpertPose, learner: ArmArrays) -> Float[Array, " joints"]:
        """The nearest of the poses after the Newton steps."""
        poses, distances = self.refined(params, expert, learner)
        return poses[jnp.argmin(distances)]

    def _tokens(self, expert: ExpertPose, learner: ArmArrays) -> tuple[Array, ...]:
        """Features of each joint, of each link, and of each link of the expert, and which of them exist.

        The learner is described in its home pose. Lengths are in chain lengths; the place of a link on the chain is the
        arc length of its middle.
        """
        frames = frame_table(learner, learner.home)
        states = states_in_frames(learner, frames)
        unit = 1 / learner.chain_length
        own, has_link = learner.is_free[:, None], (learner.link_length > 0).astype(unit.dtype)
        axes, origins = axes_and_origins(frames)
        joints = [own, own * learner.joint_range / jnp.pi, own * axes, own * unit * origins]
        joints = jnp.concatenate(joints, axis=1)
        moved_by = jax.nn.one_hot(learner.link_joint, MAX_JOINTS, dtype=unit.dtype)
        links = [states.position, states.direction, _arcs(learner), moved_by]
        links = has_link[:, None] * jnp.concatenate([x for x in links if x is not None], axis=1)
        features = [expert.states.position, expert.states.direction, _arcs(expert.arm)]
        of_expert = jnp.concatenate([x for x in features if x is not None], axis=1)[: self._expert_tokens]
        has_expert_link = jnp.asarray(expert.arm.link_length > 0, unit.dtype)[: self._expert_tokens]
        return joints, links, of_expert, learner.is_free, has_link, has_expert_link


def make_any_arm_model(env: EnvConfig, settings: PoseMapperConfig) -> AnyArmMapperModel:
    """The untrained mapper of an environment's experts and metric.

    Raises:
      ValueError: an expert that cannot be loaded or has no arrays, or a metric other than of constant weights.
    """
    expert = arm_arrays(build_arm(env.expert, env.limits, env.metric.links)).astype(np.float32)
    sizes = settings.width, settings.layers, settings.heads, settings.guesses, settings.refinements
    return AnyArmMapperModel(expert, arms_config(env).expert == "drawn", check_metric(env.metric), *sizes)


def _spread(count: int) -> Float[np.ndarray, "count joints"]:
    """Points that fill the unit cube evenly: the additive recurrence of M. Roberts (2018), which never changes."""
    root = 2.0
    for _ in range(64):
        root = (1 + root) ** (1 / (MAX_JOINTS + 1))  # solves x^(joints + 1) = x + 1
    steps = root ** -np.arange(1.0, MAX_JOINTS + 1)
    return ((0.5 + np.outer(np.arange(1, count + 1), steps)) % 1).astype(np.float32)


def _arcs(arm: ArmArrays) -> Float[Array, "links 2"]:
    """Arc length of the middle of each link, and its length, both in chain lengths."""
    lengths = arm.link_length / arm.chain_length
    return jnp.stack([jnp.cumsum(lengths) - 0.5 * lengths, lengths], axis=1)
