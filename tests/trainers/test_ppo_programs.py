"""The compiled functions of PPO: the transitions that they collect, and the loss."""

import dataclasses
import functools
import os
import subprocess
import sys
from types import SimpleNamespace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from brax.training.acme import running_statistics, specs
from brax.training.agents.ppo import losses
from brax.training.types import Transition

import mimic
from mimic.base.compilation import compiler_options
from mimic.envs.imitation import arm_state
from mimic.trainers.config import PPOConfig
from mimic.trainers.ppo import ppo
from mimic.trainers.ppo.trainer import with_crossovers
from tests.helpers.tiny import SHORT_ARMS

UNROLLS, ARMS, PASSES = 2, 4, 3
HORIZON = 50  # steps of an episode
_SCHEDULING = "xla_gpu_command_buffer_scheduling_mode"


def setup_of(config, observation_size, action_size):
    """The setup of a training of which no environment is stepped."""
    env: Any = SimpleNamespace(observation_size=observation_size, action_size=action_size, privileged_size=1)
    return ppo.make_setup(env, config, devices=1)


@pytest.fixture(scope="module")
def one_batch():
    """States before and after a batch; losses without gradient record observations, projected on `along`, and time."""
    env = mimic.make("planar4dof", **SHORT_ARMS, demonstrations={"count": 3, "held_out": 1})
    config = PPOConfig(
        num_envs=ARMS, unroll_length=1, batch_size=UNROLLS * ARMS // 2, num_minibatches=2, num_updates_per_batch=PASSES,
        hidden_layers=[8],
    ).resolve("cpu")  # fmt: skip
    along = np.random.default_rng(0).normal(size=env.observation_size).astype(np.float32)

    def of_value(params, statistics, unrolls, *_):
        assert unrolls.observation.shape == (config.batch_size, 1 + 1, env.observation_size)
        now, after = (unrolls.observation @ along).mean(axis=0)
        return now + 0.0 * sum(x.sum() for x in jax.tree.leaves(params)), after

    def of_policy(params, statistics, unrolls, after, *_):
        metrics = jnp.full(len(ppo.POLICY_METRICS), after).at[1:3].set(unrolls.privileged[..., 0].mean(axis=0))
        return 0.0 * sum(x.sum() for x in jax.tree.leaves(params)), metrics

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(ppo, "value_loss", of_value)
        patch.setattr(ppo, "policy_loss", of_policy)
        start, _, epoch = ppo.compile_training(env, config, 1)
        state = start(7)
        before = jax.device_get(state)
        after, metrics = jax.device_get(epoch()(state))
    shown = {"now": metrics["value_loss"], "next": metrics["policy_loss"]}
    shown["elapsed"] = [metrics[name] for name in ppo.POLICY_METRICS[1:3]]
    return before, after, shown, along


def test_each_pass_uses_each_transition(one_batch):
    _, after, shown, along = one_batch
    assert int(after.statistics.count.lo) == UNROLLS * ARMS
    assert shown["now"] == pytest.approx(along @ after.statistics.mean, abs=1e-5)


def test_the_next_observation_belongs_to_its_transition(one_batch):
    """In unrolls of one step, the next observation of the first is the first one of the second."""
    before, after, shown, along = one_batch
    total = UNROLLS * ARMS * after.statistics.mean - before.episodes.obs.sum(0) + after.episodes.obs.sum(0)
    assert shown["next"] == pytest.approx(along @ total / (UNROLLS * ARMS), abs=1e-5)


def test_the_elapsed_time_belongs_to_the_observation(one_batch):
    """Over two unrolls of one step each; an episode that ends starts again at 0."""
    before, after, shown, _ = one_batch
    first, last = (arm_state(state.episodes).step for state in (before, after))
    second = np.where(first + 1 < HORIZON, first + 1, 0)
    np.testing.assert_array_equal(last, np.where(second + 1 < HORIZON, second + 1, 0))
    expected = np.array([[first, second], [second, last]]).mean(axis=(1, 2)) / HORIZON
    np.testing.assert_allclose(shown["elapsed"], expected, rtol=1e-5)


def test_a_loss_without_gradient_changes_nothing_but_the_episodes(one_batch):
    before, after, *_ = one_batch
    assert jax.tree.all(jax.tree.map(np.array_equal, before.params[1:], after.params[1:]))
    np.testing.assert_array_equal(before.expert_states.position, after.expert_states.position)
    assert not np.array_equal(before.key, after.key)
    assert not np.array_equal(before.episodes.obs, after.episodes.obs)


@pytest.mark.parametrize(("time", "entropy_cost"), [(7, 0.0), pytest.param(1, 0.3, marks=pytest.mark.slow)])
def test_the_loss_is_that_of_brax(x64, time, entropy_cost):
    """The entropy is that of a sample, drawn in the same order only for unrolls of one step."""
    sizes, unrolls = (5, 3), 6
    config = PPOConfig(hidden_layers=[8, 4], entropy_cost=entropy_cost, privileged_critic=False).resolve("cpu")
    setup = setup_of(config, *sizes)
    networks = setup.networks
    rng = np.random.default_rng(time)

    def normal(*shape):
        return jnp.asarray(rng.normal(size=shape))

    statistics, *params = ppo.initial_params(networks, sizes[0], jax.random.PRNGKey(1))
    statistics = statistics.replace(mean=normal(5), std=jnp.exp(normal(5)))
    params = jax.tree.map(lambda x: x + 0.1 * normal(*x.shape), losses.PPONetworkParams(*params))
    observation, raw_action = normal(unrolls, time + 1, 5), normal(unrolls, time + 1, 3)
    log_prob, reward = normal(unrolls, time + 1), normal(unrolls, time + 1)
    goes_on = jnp.asarray(rng.random((unrolls, time + 1)) < 0.8, float)
    privileged = jnp.zeros((*reward.shape, 2))
    ours = ppo.Unrolls(observation, raw_action, privileged, log_prob - 4, reward, goes_on)
    np.testing.assert_array_equal(ours.unpacked(ours.packed()).raw_action, raw_action)
    now = jax.tree.map(lambda x: x[:, :-1], ours.unpacked(ours.packed()))
    extras = {"raw_action": now.raw_action, "log_prob": now.log_prob}
    extras["distribution_params"] = normal(unrolls, time, 6)
    theirs = Transition(
        now.observation, now.raw_action, now.reward, now.goes_on, observation[:, 1:],
        {"policy_extras": extras, "state_extras": {"truncation": jnp.zeros((unrolls, time))}},
    )  # fmt: skip
    key = jax.random.PRNGKey(2)

    def own(params):
        value, advantages = ppo.value_loss(params.value, statistics, ours, setup)
        policy, metrics = ppo.policy_loss(params.policy, statistics, ours, advantages, key, setup)
        return value + policy, dict(zip(ppo.POLICY_METRICS, metrics, strict=True), value_loss=value)

    def of_brax(params):
        names = "entropy_cost", "discounting", "reward_scaling", "gae_lambda", "clipping_epsilon"
        settings = {name: getattr(config, name) for name in names}
        return losses.compute_ppo_loss(params, statistics, theirs, key, networks, **settings)

    (loss, shown), gradient = jax.jit(jax.value_and_grad(own, has_aux=True))(params)
    (expected, named), expected_gradient = jax.jit(jax.value_and_grad(of_brax, has_aux=True))(params)
    assert loss == pytest.approx(float(expected), rel=1e-12)
    for actual, reference in zip(jax.tree.leaves(gradient), jax.tree.leaves(expected_gradient), strict=True):
        np.testing.assert_allclose(actual, reference, rtol=1e-9, atol=1e-12)
    assert -entropy_cost * shown["entropy"] == pytest.approx(float(named["entropy_loss"]), rel=1e-12, abs=1e-12)
    assert shown["policy_loss"] == pytest.approx(float(named["policy_loss"]), rel=1e-12)
    assert shown["value_loss"] == pytest.approx(float(named["v_loss"]), rel=1e-12)
    assert shown["action_std"] == pytest.approx(float(named["policy_dist_mean_std"]), rel=1e-12)
    logits = networks.policy_network.apply(statistics, params.policy, now.observation)
    log_ratio = networks.parametric_action_distribution.log_prob(logits, now.raw_action) - now.log_prob
    assert shown["approx_kl"] == pytest.approx(float((jnp.expm1(log_ratio) - log_ratio).mean()), rel=1e-9)
    clipped = np.abs(np.exp(log_ratio) - 1) > config.clipping_epsilon
    assert shown["clip_fraction"] == pytest.approx(clipped.mean()) and 0 < clipped.mean() < 1


def test_a_privileged_critic_observes_more_than_the_policy(x64):
    """Its loss is that of a critic whose observation has the privileged numbers as its last entries."""
    rng = np.random.default_rng(0)
    unrolls = ppo.Unrolls(*(jnp.asarray(rng.normal(size=(6, 4, *n))) for n in [(5,), (3,), (1,), (), (), ()]))
    statistics = running_statistics.init_state(specs.Array((5,), jnp.dtype("float64")))
    statistics = statistics.replace(mean=jnp.arange(5.0), std=1 + jnp.arange(5.0))
    longer = jax.tree.map(lambda x: x, statistics)
    longer = longer.replace(mean=jnp.append(statistics.mean, 0.0), std=jnp.append(statistics.std, 1.0))
    informed, plain = (PPOConfig(hidden_layers=[8], privileged_critic=is_so).resolve("cpu") for is_so in (True, False))
    params = setup_of(informed, 5, 3).networks.value_network.init(jax.random.PRNGKey(0))
    informed_loss, plain_loss = (
        jax.jit(functools.partial(ppo.value_loss, setup=setup))
        for setup in (setup_of(informed, 5, 3), setup_of(plain, 6, 3))
    )
    loss, _ = informed_loss(params, statistics, unrolls)
    extended = unrolls._replace(observation=jnp.concatenate([unrolls.observation, unrolls.privileged], -1))
    expected, _ = plain_loss(params, longer, extended)
    later, _ = informed_loss(params, statistics, unrolls._replace(privileged=unrolls.privileged + 1))
    assert loss == pytest.approx(float(expected), rel=1e-12) and abs(later - loss) > 1e-3


ON_TWO_DEVICES = """
import jax, numpy as np, mimic
from mimic.trainers.ppo import ppo
from mimic.trainers.config import PPOConfig
env = mimic.make("planar4dof", physics="fused", demonstrations={"count": 3, "held_out": 1})
config = PPOConfig(num_envs=8, unroll_length=2, batch_size=8, num_minibatches=2, num_updates_per_batch=2,
                   hidden_layers=[8]).resolve("cpu", 2)
start, _, epoch = ppo.compile_training(env, config, 2)
state = start(7)
before = jax.device_get(state.params)
after, metrics = epoch()(state)
changed = jax.tree.map(lambda x, y: not np.array_equal(x, y), before, jax.device_get(after.params))
assert any(jax.tree.leaves(changed))
for x in jax.tree.leaves((after.policy, after.value, after.statistics, metrics)):
    shards = [np.asarray(shard.data) for shard in x.addressable_shards]
    assert len(shards) == 2 and np.array_equal(*shards)
observed = [np.asarray(shard.data) for shard in after.episodes.obs.addressable_shards]
assert not np.array_equal(*observed)
"""


@pytest.mark.slow
def test_devices_see_different_arms_and_learn_the_same():
    flags = f"{os.environ.get('XLA_FLAGS', '')} --xla_force_host_platform_device_count=2"
    settings = {**os.environ, "JAX_PLATFORMS": "cpu", "XLA_FLAGS": flags}
    command = [sys.executable, "-c", ON_TWO_DEVICES]
    ended = subprocess.run(command, env=settings, capture_output=True, text=True, check=False)
    assert ended.returncode == 0, ended.stderr[-2000:]


def test_the_entropy_cost_changes_with_the_progress():
    config = PPOConfig(entropy_cost=0.2, final_entropy_cost=0.1).resolve("cpu")
    assert config.at(0.0) == config
    assert [config.at(progress).entropy_cost for progress in (0.5, 1.0)] == pytest.approx([0.11, 0.02])
    constant = PPOConfig().resolve("cpu")
    assert constant.at(0.5) is constant


@pytest.mark.slow
def test_a_batch_learns_by_the_settings_of_its_progress():
    env = mimic.make("planar4dof", **SHORT_ARMS, demonstrations={"count": 1, "held_out": 1})
    small = {
        "num_envs": 4, "unroll_length": 10, "batch_size": 4, "num_minibatches": 1, "num_updates_per_batch": 1,
        "hidden_layers": [8], "num_timesteps": 80, "learning_rate": 1e-3, "final_learning_rate": 1.0,
    }  # fmt: skip

    def after(batches, **settings):
        config = PPOConfig(**small, **settings).resolve("cpu")  # type: ignore[arg-type]
        start, _, epoch = ppo.compile_training(env, config, 1)
        state = start(7)
        for _ in range(batches):
            state, _ = epoch()(state)
        return jax.device_get(state.params)

    constant, decayed = {"entropy_cost": 0.2}, {"entropy_cost": 0.2, "final_entropy_cost": 0.0}
    rounding = {"rtol": 1e-5, "atol": 1e-7}  # other compiled functions, in float32
    jax.tree.map(lambda *x: np.testing.assert_allclose(*x, **rounding), after(1, **constant), after(1, **decayed))
    policies = after(2, **constant)[1], after(2, **decayed)[1]
    apart = jax.tree.map(lambda *x: float(np.abs(x[0] - x[1]).max()), *policies)
    assert max(jax.tree.leaves(apart)) > 1e-4  # Adam moves by 1e-3 an update, whatever the gradient's size


@pytest.mark.slow
def test_a_restored_state_needs_the_same_compiled_epoch(monkeypatch):
    """Compiled anew, its numbers may differ in the last bits: on a GPU, XLA chooses matrix products by their speed."""
    env = mimic.make("planar4dof", **SHORT_ARMS, demonstrations={"count": 1, "held_out": 1})
    config = PPOConfig(num_envs=4, batch_size=4, num_minibatches=1, hidden_layers=[8]).resolve("cpu")
    lowered = []
    monkeypatch.setattr(ppo, "in_background", lambda compiled: lowered.append(compiled.__self__.as_text()))
    networks = ppo.make_networks(config, env.observation_size, env.action_size, env.privileged_size)
    params = jax.device_get(ppo.initial_params(networks, env.observation_size, jax.random.PRNGKey(0)))
    for initial in (None, params):
        ppo.compile_training(env, config, 1, initial, restored=True)
    assert lowered[0] == lowered[1]


@pytest.mark.slow
def test_schedules_of_a_restored_state_begin_at_its_updates():
    env = mimic.make("planar4dof", **SHORT_ARMS, demonstrations={"count": 1, "held_out": 1})
    config = PPOConfig(num_envs=4, batch_size=4, num_minibatches=1, hidden_layers=[8]).resolve("cpu")
    functions = ppo.compile_training(env, config, 1)
    state = functions.start(7, None, 5)
    leaves = jax.tree.leaves(jax.device_get(state.saved))
    restored = functions.restore(leaves, 9)
    assert restored is not None
    for network in (restored.policy, restored.value):
        adam, schedule = network.optimizer  # type: ignore[misc]
        assert (int(adam.count), int(schedule.count)) == (0, 9)
    for leaf, saved in zip(jax.tree.leaves(functions.restore(leaves, 5)), jax.tree.leaves(state), strict=True):
        np.testing.assert_array_equal(leaf, saved)
    assert functions.restore([*leaves[:-1], leaves[-1][:1]], 5) is None


def test_both_functions_are_compiled_with_the_options_of_a_run(monkeypatch):
    monkeypatch.setattr(ppo, "compiler_options", lambda: {"no_option_of_xla": True})
    env = mimic.make("planar4dof", **SHORT_ARMS, demonstrations={"count": 1, "held_out": 1})
    config = PPOConfig(num_envs=4, batch_size=4, num_minibatches=1).resolve("cpu")
    start, _, epoch = ppo.compile_training(env, config, 1)
    for compiled in (lambda: start(7), epoch):
        with pytest.raises(jax.errors.JaxRuntimeError, match="no_option_of_xla"):
            compiled()


@pytest.mark.gpu
@pytest.mark.parametrize("physics", ["fused", "mjx"])
def test_concurrent_kernels_learn_the_same_as_sequential_ones(physics, monkeypatch):
    """Bit for bit, where XLA picks the same matrix products and order of sums."""
    env = mimic.make("panda4dof", physics=physics, demonstrations={"count": 8, "held_out": 1})
    config = PPOConfig(num_envs=1024, batch_size=256).resolve("gpu")
    defaults, learned = compiler_options(), []
    for scheduling in ("SERIALIZE", defaults[_SCHEDULING]):
        options = {**defaults, _SCHEDULING: scheduling, "xla_gpu_autotune_level": 0, "xla_gpu_deterministic_ops": True}
        monkeypatch.setattr(ppo, "compiler_options", lambda options=options: options)
        start, _, epoch = ppo.compile_training(env, config, 5)
        learned.append(jax.device_get(epoch()(start(7))))
    assert jax.tree.all(jax.tree.map(np.array_equal, *learned))


@pytest.mark.parametrize(("world", "are_displaced"), [("paper", True), ("ideal", False)])
def test_crossovers_start_anywhere_unless_there_is_an_inner_loop(world, are_displaced):
    env = mimic.make("planar4dof", world=world, demonstrations={"count": 3, "held_out": 1})
    settings = PPOConfig(crossovers=20).resolve("cpu", env=env.config)
    first = with_crossovers(env, settings, seed=0).qpos[3:, 0]
    assert np.any(first != env.expert.home) == are_displaced
    assert np.all(first >= env.expert.joint_range[:, 0]) and np.all(first <= env.expert.joint_range[:, 1])


def test_crossovers_of_motions_that_start_apart_start_where_these_do():
    env = mimic.make("planar4dof", demonstrations={"count": 3, "held_out": 1})
    apart = env.demonstrations.qpos + np.linspace(0, 0.3, 3)[:, None, None]
    env = env.with_demonstrations(dataclasses.replace(env.demonstrations, qpos=apart))
    settings = PPOConfig(crossovers=20, displaced_crossovers=1.0).resolve("cpu")
    mixed = with_crossovers(env, settings, seed=0).qpos[3:]
    whole = mixed[np.arange(20) % 4 < 3, 0]
    assert np.isclose(whole[:, None], apart[None, :, 0], atol=1e-9).any(axis=1).all()
