"""The programs of the training: what they collect, and what they learn from."""

import jax
import numpy as np
import optax
import pytest

import mimic
from mimic.trainers import learning, ppo
from mimic.trainers.config import PPOConfig

UNROLLS, ARMS, PASSES = 2, 4, 3


@pytest.fixture(scope="module")
def one_batch():
    """Before and after a batch, with a loss that changes nothing and tells what it was shown, as seen along `along`."""
    env = mimic.make("planar4dof", physics="fused", demonstrations={"count": 3, "held_out": 1})
    config = PPOConfig(
        num_envs=ARMS, unroll_length=1, batch_size=UNROLLS * ARMS // 2, num_minibatches=2, num_updates_per_batch=PASSES,
        hidden_layers=[8],
    ).resolve("cpu")  # fmt: skip
    networks = ppo.make_networks(config, env.observation_size, env.action_size)
    along = np.random.default_rng(0).normal(size=env.observation_size).astype(np.float32)

    def loss(params, statistics, data, key, **_):
        del statistics, key
        assert data.observation.shape == (config.batch_size, 1, env.observation_size)
        shown = {"now": (data.observation @ along).mean(), "next": (data.next_observation @ along).mean()}
        return 0.0 * sum(x.sum() for x in jax.tree.leaves(params)), shown

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(learning.losses, "compute_ppo_loss", loss)
        begin, learn = learning.make_programs(env, config, networks, 1, optax.constant_schedule(1e-3), None)
        start = begin()(7)
        before = jax.device_get(start)
        after, shown = jax.device_get(learn()(start))
    return before, after, shown, along


def test_each_pass_shows_the_loss_each_transition(one_batch):
    _, after, shown, along = one_batch
    assert int(after.statistics.count.lo) == UNROLLS * ARMS
    assert shown["now"] == pytest.approx(along @ after.statistics.mean, abs=1e-5)


def test_what_is_seen_next_belongs_to_its_transition(one_batch):
    """Of unrolls of one step, what follows the first is what the second begins with."""
    before, after, shown, along = one_batch
    seen = UNROLLS * ARMS * after.statistics.mean - before.episodes.obs.sum(0) + after.episodes.obs.sum(0)
    assert shown["next"] == pytest.approx(along @ seen / (UNROLLS * ARMS), abs=1e-5)


def test_a_loss_without_gradient_changes_nothing_but_the_episodes(one_batch):
    before, after, *_ = one_batch
    assert jax.tree.all(jax.tree.map(np.array_equal, before.networks, after.networks))
    np.testing.assert_array_equal(before.expert_states.position, after.expert_states.position)
    assert not np.array_equal(before.key, after.key)
    assert not np.array_equal(before.episodes.obs, after.episodes.obs)
