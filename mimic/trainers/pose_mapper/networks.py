"""The networks of pose mappers: each maps a `Target` to two numbers for each joint of the learner and each head."""

import jax
import jax.numpy as jnp
import numpy as np
from flax import linen as nn
from jaxtyping import Array, Float

from mimic.arms.arrays import MAX_JOINTS, ArmArrays
from mimic.arms.embodiment import Embodiment
from mimic.arms.pose_limits import continuous_joints
from mimic.metric.kinematics import axes_and_origins, frame_table, states_in_frames
from mimic.retargeting.pose import wrap_angles
from mimic.trainers.networks import Transformer
from mimic.trainers.pose_mapper.pair import Target

_ACTIVATIONS = {"leaky_relu": nn.leaky_relu, "gelu": nn.gelu}


class FullyConnected(nn.Module):
    """A fully connected network of the expert's pose, for one pair of arms; arguments as of `PoseMapperConfig`."""

    heads: int
    hidden_layers: tuple[int, ...]
    activation: str
    inputs: str

    @nn.compact
    def __call__(self, target: Target) -> Float[Array, "heads joints 2"]:
        """Numbers of each joint, see `poses_within_range`."""
        assert isinstance(target.pair.learner, Embodiment)
        x = _link_inputs(target) if self.inputs == "link_states" else _angle_inputs(target)
        for width in self.hidden_layers:
            x = _ACTIVATIONS[self.activation](nn.Dense(width)(x))
        joints = target.pair.learner.num_joints
        return jnp.reshape(nn.Dense(self.heads * joints * 2)(x), (self.heads, joints, 2))


def _link_inputs(target: Target) -> Array:
    assert target.states.direction is not None
    states, has_hand = target.states, not target.pair.metric.hand_weights.are_zero
    parts = [states.position, states.direction, *([states.hand.axes] if has_hand and states.hand else [])]
    return jnp.concatenate([part.ravel() for part in parts])


def _angle_inputs(target: Target) -> Array:
    expert, qpos = target.pair.expert, target.qpos
    assert isinstance(expert, Embodiment)
    lower, upper = (jnp.asarray(bound, qpos.dtype) for bound in np.asarray(expert.joint_range).T)
    return (2 * wrap_angles(qpos, continuous_joints(expert)) - lower - upper) / (upper - lower)


class JointTokens(nn.Module):
    """A transformer over the joints and links of any learner and the links of an expert, in a pose.

    Attributes:
      heads: number of poses that it proposes.
      width: of a token.
      layers: of the transformer.
      expert_links: number of tokens for the links of an expert.
    """

    heads: int
    width: int
    layers: int
    expert_links: int

    @nn.compact
    def __call__(self, target: Target) -> Float[Array, "heads joints 2"]:
        """Numbers of each joint, see `poses_within_range`."""
        groups, present = [], []
        for name, features, exists in _features(target, self.expert_links):
            place = self.param(f"{name}_place", nn.initializers.normal(0.1), (len(features), self.width))
            groups.append(nn.Dense(self.width, name=name)(features) + place)
            present.append(exists)
        tokens = Transformer(self.width, self.layers)(jnp.concatenate(groups), jnp.concatenate(present) > 0)
        outputs = nn.Dense(2 * self.heads, name="outputs")(tokens[:MAX_JOINTS])
        return jnp.moveaxis(outputs.reshape(MAX_JOINTS, self.heads, 2), -2, -3)


def _features(target: Target, expert_links: int) -> list[tuple[str, Array, Array]]:
    """Features of each joint, of each link, and of each link of the expert, and which of them exist.

    The learner is described in its home pose. Lengths are in chain lengths; the place of a link on the chain is the
    arc length of its middle.
    """
    expert, learner = target.pair.expert, target.pair.learner
    assert isinstance(expert, ArmArrays) and isinstance(learner, ArmArrays)
    frames = frame_table(learner, jnp.asarray(learner.home))
    states, (axes, origins) = states_in_frames(learner, frames), axes_and_origins(frames)
    unit = 1 / learner.chain_length
    own, has_link = learner.is_free[:, None], (learner.link_length > 0).astype(unit.dtype)
    joints = [own, own * learner.joint_range / jnp.pi, own * axes, own * unit * origins]
    moved_by = jax.nn.one_hot(learner.link_joint, MAX_JOINTS, dtype=unit.dtype)
    links = [states.position, states.direction, _arcs(learner), moved_by]
    of_expert = [target.states.position, target.states.direction, _arcs(expert)]
    has_expert_link = jnp.asarray(expert.link_length > 0, unit.dtype)
    return [
        ("joints", _joined(joints), learner.is_free),
        ("links", has_link[:, None] * _joined(links), has_link),
        ("expert", _joined(of_expert)[:expert_links], has_expert_link[:expert_links]),
    ]


def _joined(features: list[Array | None]) -> Array:
    return jnp.concatenate([x for x in features if x is not None], axis=1)


def _arcs(arm: ArmArrays) -> Float[Array, "links 2"]:
    """Arc length of the middle of each link, and its length, both in chain lengths."""
    lengths = arm.link_length / arm.chain_length
    return jnp.stack([jnp.cumsum(lengths) - 0.5 * lengths, lengths], axis=1)
