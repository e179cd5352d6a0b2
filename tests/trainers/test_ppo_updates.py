"""PPO's updates of policy and value, over several simulated devices."""

import dataclasses
import functools
import itertools
from types import SimpleNamespace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

from mimic.trainers.config import PPOConfig
from mimic.trainers.ppo import ppo

DEVICES, UNROLLS, TIME, UPDATES, MINIBATCH = 2, 6, 3, 5, 4
LIMIT = 2.2  # of gradients: the norm of both is above it in each update, that of the value's in the fourth alone
OBSERVED, ACTIONS = 5, 2


@dataclasses.dataclass
class Case:
    """Data and settings of updates; the first axis of each array is the device."""

    config: PPOConfig
    unrolls: ppo.Unrolls
    order: jax.Array
    keys: jax.Array

    def __post_init__(self):
        env: Any = SimpleNamespace(observation_size=OBSERVED, action_size=ACTIONS, privileged_size=1)
        # With an epsilon of this size Adam's steps depend on the size of the gradient.
        self.optimizer = optax.adam(optax.constant_schedule(0.01), eps=0.1)
        self.setup = ppo.make_setup(env, self.config, DEVICES)._replace(optimizer=self.optimizer)
        self.networks = self.setup.networks
        self.statistics, *self.params = ppo.initial_params(self.networks, OBSERVED, jax.random.PRNGKey(1))

    def on_device(self, staggered, devices, unrolls, order, key):
        """Policy, value and metrics by mimic."""
        policy, value = (ppo.begin(params, self.optimizer) for params in self.params)
        setup = self.setup._replace(is_staggered=staggered, devices=devices)
        return ppo.update((policy, value), ppo.Batch(self.statistics, unrolls, order, key), setup)

    def expected(self):
        """The expected result: one update after the other, with means over the devices."""
        params = list(self.params)
        states = [self.optimizer.init(network) for network in params]
        metrics = []
        keys = jnp.stack([jax.random.split(key, UPDATES) for key in self.keys])
        for i in range(UPDATES):
            gradients, shown = [], []
            for device in range(DEVICES):
                minibatch = jax.tree.map(lambda x, at=self.order[device, i], device=device: x[device][at], self.unrolls)
                data = self.statistics, minibatch
                of = self.setup
                (error, advantages), of_value = jax.value_and_grad(ppo.value_loss, has_aux=True)(params[1], *data, of)
                of_policy, of_loss = jax.grad(ppo.policy_loss, has_aux=True)(
                    params[0], *data, advantages, keys[device, i], of
                )
                gradients.append((of_policy, of_value))
                shown.append(jnp.append(error, of_loss))
            metrics.append(shown)
            means = jax.tree.map(lambda *x: sum(x) / DEVICES, *gradients)
            norms = optax.global_norm(means), optax.global_norm(means[1])
            for j, norm in enumerate(norms):
                mean = jax.tree.map(lambda x, norm=norm: x * min(1, LIMIT / norm), means[j])
                change, states[j] = self.optimizer.update(mean, states[j])
                params[j] = optax.apply_updates(params[j], change)
        return params, np.mean(metrics, axis=0)


@pytest.fixture
def case(x64):
    rng = np.random.default_rng(0)

    def normal(*shape):
        return jnp.asarray(rng.normal(size=(DEVICES, UNROLLS, TIME + 1, *shape)))

    goes_on = jnp.asarray(rng.random((DEVICES, UNROLLS, TIME + 1)) < 0.8, float)
    unrolls = ppo.Unrolls(normal(OBSERVED), normal(ACTIONS), normal(1), normal() - 3, normal(), goes_on)
    order = jnp.asarray([[rng.permutation(UNROLLS)[:MINIBATCH] for _ in range(UPDATES)] for _ in range(DEVICES)])
    config = dataclasses.replace(PPOConfig(hidden_layers=[8, 4]).resolve("cpu"), max_grad_norm=LIMIT)
    return Case(config, unrolls, order, jax.random.split(jax.random.PRNGKey(2), DEVICES))


@pytest.mark.slow
@pytest.mark.parametrize(("staggered", "devices"), [(False, 1), (True, 2)])
def test_updates_equal_those_of_each_minibatch_in_turn(case, staggered, devices):
    """With one device the compiled loop has one update an iteration, otherwise two."""
    on_all = jax.jit(jax.vmap(functools.partial(case.on_device, staggered, devices), axis_name="devices"))
    learners, metrics = on_all(case.unrolls, case.order, case.keys)
    params, expected_metrics = case.expected()
    np.testing.assert_allclose(metrics, expected_metrics, rtol=1e-5, atol=1e-7)
    for learner, expected, before in zip(learners, params, case.params, strict=True):
        for actual, reference, old in zip(*map(jax.tree.leaves, (learner.params, expected, before)), strict=True):
            np.testing.assert_array_equal(actual[0], actual[1])  # on both devices
            np.testing.assert_allclose(actual[0], reference, rtol=1e-5, atol=1e-7)
            assert not np.array_equal(reference, old)
        assert set(np.ravel(learner.optimizer[0].count)) == {UPDATES}


def test_each_all_reduce_waits_for_the_one_before(case, monkeypatch):
    """Else NCCL could get two in parallel, in a different order on each GPU."""
    scan = jax.lax.scan

    def in_a_row(body, carry, inputs, **options):
        if options.get("reverse"):  # the advantages
            return scan(body, carry, inputs, **options)
        outputs = []
        for i in range(UPDATES):
            carry, output = body(carry, jax.tree.map(lambda x, i=i: x[i], inputs))
            outputs.append(output)
        return carry, jnp.stack(outputs)

    monkeypatch.setattr(jax.lax, "scan", in_a_row)
    of_one = jax.tree.map(lambda x: x[0], (case.unrolls, case.order, case.keys))
    on_one = functools.partial(case.on_device, True, 1)
    program = jax.make_jaxpr(on_one, axis_env=[("devices", DEVICES)])(*of_one).jaxpr
    reductions = [equation for equation in program.eqns if equation.primitive.name.startswith("psum")]
    assert len(reductions) == 2 * UPDATES + 1
    for before, after in itertools.pairwise(reductions):
        assert after.outvars[0] in _made_of(before.outvars, program)
    *_, metrics = program.outvars  # whose mean is sent next
    assert metrics in _made_of(reductions[-1].outvars, program)


def _made_of(variables, program):
    dependent = set(variables)
    for equation in program.eqns:
        if dependent.intersection(v for v in equation.invars if not hasattr(v, "val")):
            dependent.update(equation.outvars)
    return dependent


@pytest.mark.parametrize("privileged", [False, True])
def test_padded_inputs_change_no_output(privileged, monkeypatch):
    config = PPOConfig(hidden_layers=[16], privileged_critic=privileged, network="mlp")
    networks = ppo.make_networks(config, OBSERVED, ACTIONS, privileged_size=1)
    statistics, policy, value = ppo.initial_params(networks, OBSERVED, jax.random.PRNGKey(0))
    observation = jax.random.normal(jax.random.PRNGKey(1), (4, OBSERVED + privileged))

    def outputs():
        logits = networks.policy_network.apply(statistics, policy, observation[:, :OBSERVED])
        return logits, networks.value_network.apply(statistics, value, observation)

    expected = outputs()
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    assert ppo._aligned(observation, -1).shape == (4, 8)
    jax.tree.map(functools.partial(np.testing.assert_allclose, rtol=1e-5, atol=1e-6), outputs(), expected)
