"""Reward and observation terms: functions that packages and notebooks add to an environment, see `mimic.register`."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from mimic import registry
from mimic.envs.arm_state import ArmState
from mimic.metric.kinematics import LinkStates

Env = Any  # an `ImitationEnv`, which imports this module


class Transition(NamedTuple):
    """A control step, for reward terms.

    Attributes:
      before: state of the episode before the step.
      after: state after the step.
      action: [joints] the action, in [-1, 1].
      torque: [joints] constant torque in the step [N m].
      learner_states: link states of the learner after the step.
      expert_states: link states of the expert at the same time.
    """

    before: ArmState
    after: ArmState
    action: Float[Array, " joints"]
    torque: Float[Array, " joints"]
    learner_states: LinkStates
    expert_states: LinkStates


RewardTerm = Callable[[Env, Transition], Float[Array, ""]]
ObservationTerm = Callable[[Env, ArmState], Float[Array, " numbers"]]


class WeightedTerm(NamedTuple):
    """A reward term with its weight."""

    name: str
    weight: float
    function: RewardTerm

    @property
    def metric(self) -> str:
        """Name of the term's value in the metrics of a step."""
        return f"reward/{self.name}"

    def value(self, env: Env, transition: Transition) -> Float[Array, ""]:
        """The unweighted term. Raises a ValueError where it is no number."""
        value = jnp.asarray(self.function(env, transition), jnp.float32)
        if value.shape != ():
            raise ValueError(f"reward_term {self.name!r}: expected a number, got shape {list(value.shape)}")
        return value


def reward_terms(weights: Mapping[str, float]) -> tuple[WeightedTerm, ...]:
    """The terms of `reward.terms`. Raises a ValueError for an unknown name."""
    return tuple(
        WeightedTerm(name, float(weight), registry.find("reward_term", name, "reward.terms"))
        for name, weight in weights.items()
    )


def observation_terms(names: Sequence[str]) -> tuple[tuple[str, ObservationTerm], ...]:
    """The terms of `observation.terms`. Raises a ValueError for an unknown name."""
    return tuple((name, registry.find("observation_term", name, "observation.terms")) for name in names)


def observed(name: str, term: ObservationTerm, env: Env, state: ArmState) -> Float[Array, " numbers"]:
    """The value of an observation term. Raises a ValueError where it is no vector."""
    value = jnp.asarray(term(env, state), jnp.float32)
    if value.ndim != 1:
        raise ValueError(f"observation_term {name!r}: expected a vector, got shape {list(value.shape)}")
    return value


def observation_layout_of_terms(env: Env, start: int) -> list[dict[str, Any]]:
    """The parts of an observation that its terms add, from an index on, as in `observation_layout`."""
    layout = []
    for name, term in env.observation_terms:
        size = jax.eval_shape(
            lambda term=term, name=name: observed(name, term, env, env.start(jax.random.PRNGKey(0)))
        ).size
        layout.append({"name": f"term: {name}", "shape": [size], "unit": "", "start": start, "stop": start + size})
        start += size
    return layout
