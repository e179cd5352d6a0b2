"""The pose mapper of any arm: one network from a pose of the expert and the description of a learner to its pose."""

import dataclasses
import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import linen as nn
from jaxtyping import Array, Float

from mimic.any_arm.arrays import MAX_JOINTS, ArmArrays
from mimic.any_arm.kinematics import correspondence, joint_states, link_states, link_states_in_frames, make_metric
from mimic.any_arm.nearest import angle_limits, nearest_pose
from mimic.metric.distance import DistanceWeights
from mimic.metric.kinematics import LinkStates
from mimic.trainers.networks import Transformer

Params = Any


class _Network(nn.Module):
    """Tokens of the learner's joints and links and of the expert's links -> numbers of each joint for each head."""

    width: int
    layers: int
    heads: int

    @nn.compact
    def __call__(self, joints: Array, links: Array, expert: Array, is_free: Array, has_link: Array) -> Array:
        groups = []
        for name, group in (("joints", joints), ("links", links), ("expert", expert)):
            place = self.param(f"{name}_place", nn.initializers.normal(0.1), (group.shape[-2], self.width))
            groups.append(nn.Dense(self.width, name=name)(group) + place)
        present = jnp.concatenate([is_free, has_link, jnp.ones_like(expert[..., 0])], axis=-1) > 0
        tokens = Transformer(self.width, self.layers)(jnp.concatenate(groups, axis=-2), present)
        outputs = nn.Dense(2 * self.heads, name="outputs")(tokens[..., :MAX_JOINTS, :])
        return jnp.moveaxis(outputs.reshape(*outputs.shape[:-1], self.heads, 2), -2, -3)


@dataclasses.dataclass(frozen=True, eq=False)
class AnyArmMapperModel:
    """A mapper without its parameters: pure functions of one pose and one learner; batch with `jax.vmap`.

    Attributes:
      expert: the arm that is imitated, as NumPy arrays.
      weights: of the metric.
      width: of the network's tokens.
      layers: of its transformer.
      heads: number of poses that it proposes.
      refinements: Newton steps from each proposed pose.
    """

    expert: ArmArrays
    weights: DistanceWeights
    width: int
    layers: int
    heads: int
    refinements: int

    @functools.cached_property
    def _network(self) -> _Network:
        return _Network(self.width, self.layers, self.heads)

    @functools.cached_property
    def _expert_links(self) -> int:
        return int(np.count_nonzero(self.expert.link_length))

    def init(self, key: Array) -> Params:
        """Random parameters."""
        states = link_states(self.expert, jnp.zeros(MAX_JOINTS))
        return self._network.init(key, *self._tokens(states, self.expert))

    def candidates(self, params: Params, expert: LinkStates, learner: ArmArrays) -> Float[Array, "heads joints"]:
        """The poses that the heads propose [rad]; locked joints stay at home.

        Args:
          params: parameters of the network.
          expert: link states of the expert, [links, 3] with the slots of `ArmArrays`.
          learner: the learner.
        """
        outputs = self._network.apply(params, *self._tokens(expert, learner))
        assert isinstance(outputs, Array)
        lower, upper = learner.joint_range[:, 0], learner.joint_range[:, 1]
        within = (lower + upper) / 2 + (upper - lower) / 2 * jnp.tanh(outputs[..., 0])
        on_circle = learner.home + jnp.arctan2(outputs[..., 1], outputs[..., 0])
        poses = jnp.where(jnp.isinf(angle_limits(learner)[0]), on_circle, within)
        return jnp.where(learner.is_free > 0, poses, learner.home)

    def distance(self, expert: LinkStates, learner: ArmArrays, qpos: Float[Array, " joints"]) -> Float[Array, ""]:
        """Embodiment distance between the expert's pose and a learner's, both at rest."""
        metric = make_metric(self.weights, correspondence(self.expert, learner))
        return metric(expert, link_states(learner, qpos))

    def refined(
        self, params: Params, expert: LinkStates, learner: ArmArrays
    ) -> tuple[Float[Array, "heads joints"], Float[Array, " heads"]]:
        """The proposed poses after the Newton steps, and their distances."""
        matrix = correspondence(self.expert, learner)

        def refine(qpos: Array) -> Array:
            return nearest_pose(learner, self.weights, matrix, expert, qpos, self.refinements).qpos

        poses = self.candidates(params, expert, learner)
        if self.refinements:
            poses = jax.vmap(refine)(poses)
        return poses, jax.vmap(lambda qpos: self.distance(expert, learner, qpos))(poses)

    def __call__(self, params: Params, expert: LinkStates, learner: ArmArrays) -> Float[Array, " joints"]:
        """The nearest of the proposed poses."""
        poses, distances = self.refined(params, expert, learner)
        return poses[jnp.argmin(distances)]

    def _tokens(self, expert: LinkStates, learner: ArmArrays) -> tuple[Array, ...]:
        """Features of each joint, of each link, and of each link of the expert, and which of them exist.

        The learner is described in its home pose. Lengths are in chain lengths; the place of a link on the chain is the
        arc length of its middle.
        """
        frames = joint_states(learner, learner.home)
        states = link_states_in_frames(learner, frames)
        unit = 1 / learner.chain_length
        own, has_link = learner.is_free[:, None], (learner.link_length > 0).astype(unit.dtype)
        joints = [own, own * learner.joint_range / jnp.pi, own * frames.rotation[1:, :, 2]]
        joints = jnp.concatenate([*joints, own * unit * frames.origin[1:]], axis=1)
        moved_by = jax.nn.one_hot(learner.link_joint, MAX_JOINTS, dtype=unit.dtype)
        links = [states.position, states.direction, _arcs(learner), moved_by]
        links = has_link[:, None] * jnp.concatenate([x for x in links if x is not None], axis=1)
        features = [expert.position, expert.direction, _arcs(self.expert)]
        of_expert = jnp.concatenate([x for x in features if x is not None], axis=1)[: self._expert_links]
        return joints, links, of_expert, learner.is_free, has_link


def _arcs(arm: ArmArrays) -> Float[Array, "links 2"]:
    """Arc length of the middle of each link, and its length, both in chain lengths."""
    lengths = arm.link_length / arm.chain_length
    return jnp.stack([jnp.cumsum(lengths) - 0.5 * lengths, lengths], axis=1)
