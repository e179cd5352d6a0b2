"""What docs/recipes.md claims beyond its code; the recipes themselves run in test_pages.py."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import mimic
from tests.helpers.pages import REPOSITORY, read_blocks

PAGE = REPOSITORY / "docs" / "recipes.md"
SMALL = {"physics": "fused", "horizon": 5, "demonstrations": {"count": 4, "held_out": 2}}


def block_with(text):
    """The block of the page that contains a text."""
    blocks = [block for block in read_blocks(PAGE.read_text()) if text in block.text]
    assert len(blocks) == 1
    return blocks[0].text


@pytest.mark.slow
def test_the_pure_jax_loop_learns():
    """With more updates than the page has: the mean return of the last tenth is above that of the first."""
    env = mimic.make("planar4dof", **SMALL)
    code = block_with("def update(carry, key)").replace("UPDATES, HIDDEN = 32, 5, 16", "UPDATES, HIDDEN = 32, 200, 16")
    scope: dict = {"env": env, "jax": jax, "jnp": jnp}
    exec(code, scope)  # noqa: S102 - our own text
    returns = np.asarray(scope["episode_returns"])
    assert len(returns) == 200
    assert returns[-20:].mean() > returns[:20].mean() + 0.1 * abs(returns[:20].mean())
