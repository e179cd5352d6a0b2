"""Reward and observation terms: functions that a config adds to an environment, built in or of `mimic.register`."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from mimic.base import registry
from mimic.envs.arm_state import ArmState
from mimic.envs.config import REWARD_TERMS
from mimic.envs.start_poses import CLEARANCE
from mimic.metric.capsule_distances import capsule_axes, intrusion, pair_distances
from mimic.metric.kinematics import LinkStates, link_states

Env = Any  # an `ImitationEnv`, which imports this module


class Transition(NamedTuple):
    """A control step, for reward terms.

    Attributes:
      before: state of the episode before the step.
      after: state after the step.
      action: [numbers] the action, in [-1, 1].
      torque: [joints] constant torque in the step [N m]; with an inner loop that of its last period.
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
        """The unweighted term. Raises a ValueError where it fails or is no number."""
        value = _value("reward_term", self.name, self.function, env, transition)
        if value.shape != ():
            raise ValueError(f"reward_term {self.name!r}: expected a number, got shape {list(value.shape)}")
        return value


def _value(kind: str, name: str, function: Callable[..., Any], *arguments: Any) -> Array:
    """The value of a term as an array. Raises a ValueError with its name where the function raises anything."""
    try:
        return jnp.asarray(function(*arguments), jnp.float32)
    except Exception as error:
        first_line = str(error).strip().partition("\n")[0]
        raise ValueError(f"{kind} {name!r}: {type(error).__name__}: {first_line}") from error


def check_reward_terms(env: Env) -> None:
    """Traces each reward term once. Raises a ValueError that names the first one that fails or is no number."""

    def values(key: Array) -> list[Array]:
        start = env.start(key)
        action, torque = jnp.zeros(env.action_size), jnp.zeros(env.learner.num_joints)
        learner_states = link_states(env.learner, start.qpos, start.qvel)
        expert_states = env.expert_at(start.demonstration, start.step)
        transition = Transition(start, start, action, torque, learner_states, expert_states)
        return [term.value(env, transition) for term in env.reward_terms]

    if env.reward_terms:
        jax.eval_shape(values, jax.random.PRNGKey(0))


def self_collision(env: Env, transition: Transition) -> Float[Array, ""]:
    """-x / (1 + x) for the intrusion x of the learner's capsules into a clearance of 5 cm, see `Costs.self_collision`.

    Without the pairs whose distance no joint changes. Links do not touch in the simulation: this is all that keeps them
    apart.
    """
    capsules, pairs = env.capsules, env.changing_pairs
    if not pairs.any():
        return jnp.zeros(())
    axes = capsule_axes(env.learner, capsules, transition.after.qpos)
    x = intrusion(pair_distances(capsules, *axes)[pairs], CLEARANCE)
    return -x / (1 + x)


_BUILT_IN_REWARD_TERMS: dict[str, RewardTerm] = dict(zip(REWARD_TERMS, (self_collision,), strict=True))


def reward_terms(weights: Mapping[str, float]) -> tuple[WeightedTerm, ...]:
    """The terms of `reward.terms`. Raises a ValueError for an unknown name."""
    return tuple(
        WeightedTerm(
            name,
            float(weight),
            _BUILT_IN_REWARD_TERMS.get(name) or registry.find("reward_term", name, "reward.terms"),
        )
        for name, weight in weights.items()
    )


def observation_terms(names: Sequence[str]) -> tuple[tuple[str, ObservationTerm], ...]:
    """The terms of `observation.terms`. Raises a ValueError for an unknown name."""
    return tuple((name, registry.find("observation_term", name, "observation.terms")) for name in names)


def observed(name: str, term: ObservationTerm, env: Env, state: ArmState) -> Float[Array, " numbers"]:
    """The value of an observation term. Raises a ValueError where it fails or is no vector."""
    value = _value("observation_term", name, term, env, state)
    if value.ndim != 1:
        raise ValueError(f"observation_term {name!r}: expected a vector, got shape {list(value.shape)}")
    return value
