"""`python -m benchmarks.ppo`."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import mimic
from benchmarks import ppo
from benchmarks.peers import stock
from mimic.trainers.config import PPOConfig

SMALL = PPOConfig(
    preset="cpu", num_envs=8, unroll_length=5, batch_size=8, num_minibatches=2, num_updates_per_batch=1,
    hidden_layers=[8],
).resolve("cpu")  # fmt: skip


def test_the_first_epoch_is_not_counted():
    assert ppo.rates(100, [1.0, 8.0, 10.0, 12.0, 14.0]) == {"compile_s": 5.0, "steps_per_s": 50.0, "spread": 0.0}


@pytest.mark.slow
def test_the_stock_environment_is_the_same_task():
    """Rewards and observations of one episode are the imitation environment's, and it begins again after that."""
    env = mimic.make("planar4dof", physics="mjx", demonstrations={"count": 3, "held_out": 1})
    wrapped = stock.wrap(stock.StockEnv(env), env.config.horizon + 1)
    keys = jax.random.split(jax.random.PRNGKey(0), 2)
    ours, theirs = jax.jit(jax.vmap(env.reset))(keys), jax.jit(wrapped.reset)(keys)
    our_step, their_step = jax.jit(jax.vmap(env.step)), jax.jit(wrapped.step)
    action = jnp.full((2, env.action_size), 0.05)
    for _ in range(env.config.horizon):
        np.testing.assert_allclose(theirs.obs, ours.obs, atol=1e-3)  # float32, 50 times ten Runge-Kutta steps
        ours, theirs = our_step(ours, action), their_step(theirs, action)
        np.testing.assert_allclose(theirs.reward, ours.reward, atol=1e-3)
    assert theirs.done.all() and not theirs.info["truncation"].any()
    np.testing.assert_allclose(theirs.obs, theirs.info["first_obs"])


@pytest.mark.slow
@pytest.mark.parametrize("case", ["brax's loop, fused", "brax's loop, mjx.Data carried"])
def test_brax_own_loop_learns_on_both_environments(case):
    row = ppo.run("planar4dof", SMALL, case, batches=1)
    assert "failed" not in row and row["steps_per_s"] > 0
