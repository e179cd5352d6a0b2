"""Networks over the parts of an arm: each joint or link is a token, and attention lets them know of each other."""

import jax.numpy as jnp
from flax import linen as nn
from jaxtyping import Array, Bool, Float


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
