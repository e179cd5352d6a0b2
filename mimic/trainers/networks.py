"""A network over the joints of an arm: each is a token, and attention lets them know of each other."""

import jax.numpy as jnp
import numpy as np
from flax import linen as nn
from jaxtyping import Array, Bool, Float

from mimic.arms.arrays import MAX_JOINTS
from mimic.envs.many_arms_observation import JOINT_FEATURES

# Standard deviation of an untrained policy, whose mean is the zero action: the controller is good from the start, and
# noise of the usual size would hide it.
_JOINT_STD = 0.05


class Transformer(nn.Module):
    """Pre-norm transformer blocks over tokens of which some may be missing (Xiong et al., 2020).

    Attributes:
      width: of a token.
      layers: number of blocks.
      heads: of the attention, a divisor of the width.
    """

    width: int
    layers: int
    heads: int = 4

    @nn.compact
    def __call__(
        self, tokens: Float[Array, "*batch tokens width"], present: Bool[Array, "*batch tokens"]
    ) -> Float[Array, "*batch tokens width"]:
        """The tokens after all blocks; those that are missing change none of the others."""
        mask = jnp.broadcast_to(present[..., None, None, :], (*present.shape[:-1], 1, *2 * present.shape[-1:]))
        for _ in range(self.layers):
            normal = nn.LayerNorm()(tokens)
            tokens = tokens + nn.MultiHeadDotProductAttention(self.heads)(normal, normal, mask=mask)
            hidden = nn.silu(nn.Dense(2 * self.width)(nn.LayerNorm()(tokens)))
            tokens = tokens + nn.Dense(self.width)(hidden)
        return nn.LayerNorm()(tokens)


class JointPolicy(nn.Module):
    """A policy of any arm: a token for each joint, with the same weights for all of them but for its place.

    Attributes:
      width: of a token.
      layers: of the transformer.
      summary: width of the layer between the numbers of the whole arm and the tokens.
    """

    width: int = 64
    layers: int = 2
    summary: int = 128

    @nn.compact
    def __call__(
        self, observation: Float[Array, "*batch observation"], is_free: Float[Array, "*batch joints"]
    ) -> Float[Array, "*batch parameters"]:
        """Parameters of brax's normal distribution: means, then deviations before its softplus.

        Args:
          observation: of `mimic.envs.many_arms_observation.observe`, normalised.
          is_free: 1 for a joint that moves, 0 for a locked one.
        """
        split = JOINT_FEATURES * MAX_JOINTS
        of_joints = observation[..., :split].reshape(*observation.shape[:-1], MAX_JOINTS, JOINT_FEATURES)
        whole = nn.Dense(self.width)(nn.silu(nn.Dense(self.summary)(observation[..., split:])))
        place = self.param("place", nn.initializers.normal(0.02), (MAX_JOINTS, self.width))
        tokens = nn.Dense(self.width)(of_joints) + place + whole[..., None, :]
        tokens = Transformer(self.width, self.layers)(tokens, is_free > 0)
        bias = jnp.array([0.0, np.log(np.expm1(_JOINT_STD))])  # mean and deviation, whatever the observation is
        actions = nn.Dense(2, kernel_init=nn.initializers.zeros, bias_init=lambda *_: bias, name="joints")(tokens)
        return jnp.concatenate([actions[..., 0], actions[..., 1]], axis=-1)
