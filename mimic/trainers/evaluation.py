"""How good a controller is: every demonstration once, against the kinematic bound and against holding still."""

import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from brax.envs.base import State
from flax import struct
from jaxtyping import Array, Float

from mimic.envs.demonstrations import Demonstrations, concatenate
from mimic.envs.imitation import ImitationEnv, link_state_program
from mimic.imitation import kinematic_bound

Controller = Callable[[Array], Array]  # observation -> action
SPLITS = ("train", "held_out")


@struct.dataclass
class Rollouts:
    """What a controller did on each demonstration.

    Attributes:
      qpos: [demonstrations, T, joints] learner's joint angles after each step [rad].
      qvel: [demonstrations, T, joints] its velocities [rad/s].
      distance: [demonstrations, T] embodiment distance after each step.
      torque_saturation: [demonstrations, T] 1 where a torque is at its limit.
    """

    qpos: Float[Array, "demonstrations time joints"]
    qvel: Float[Array, "demonstrations time joints"]
    distance: Float[Array, "demonstrations time"]
    torque_saturation: Float[Array, "demonstrations time"]


class Evaluator:
    """Evaluates controllers on the training and the held-out demonstrations of an environment.

    Args:
      env: the training environment.
      held_out: demonstrations that are not trained on.

    Attributes:
      training_env: the environment that was given.
      env: the same environment on all demonstrations, training first.
    """

    def __init__(self, env: ImitationEnv, held_out: Demonstrations):
        self.training_env = env
        self._num_train = env.demonstrations.count
        self.env = env.with_demonstrations(concatenate(env.demonstrations, held_out))
        self._learner_states = link_state_program(self.env.learner)

    @functools.cached_property
    def lower_bound(self) -> Float[np.ndarray, "demonstrations time"]:
        """The kinematic bound; computed when it is first asked for."""
        return np.asarray(_lower_bound(self.env))

    @functools.cached_property
    def hold_distance(self) -> Float[np.ndarray, "demonstrations time"]:
        """Distance of the learner at rest in its home pose."""
        return np.asarray(_hold_distance(self.env))

    def rollout(self, controller: Controller) -> Rollouts:
        """Runs a controller on every demonstration; the caller jits this, with the parameters inside."""
        env = self.env

        def one(demonstration: Array) -> Rollouts:
            arm_state = env.start(jax.random.PRNGKey(0), demonstration)
            state = env.reset(jax.random.PRNGKey(0)).replace(pipeline_state=arm_state, obs=env.observe(arm_state))

            def step(state: State, _: None) -> tuple[State, Rollouts]:
                state = env.step(state, controller(state.obs))
                metrics = state.metrics
                arm_state: Any = state.pipeline_state
                return state, Rollouts(
                    arm_state.qpos, arm_state.qvel, metrics["distance"], metrics["torque_saturation"]
                )

            return jax.lax.scan(step, state, None, length=env.config.horizon)[1]

        return jax.vmap(one)(jnp.arange(env.demonstrations.count))

    @property
    def parts(self) -> dict[str, slice]:
        """Which demonstrations are trained on, and which are held out."""
        return {"train": slice(0, self._num_train), "held_out": slice(self._num_train, None)}

    def summary(self, rollouts: Rollouts) -> dict[str, Any]:
        """The quality figures of a controller, for the training and the held-out demonstrations."""
        distance = np.asarray(rollouts.distance)
        parts = self.parts

        def mean(values: np.ndarray) -> dict[str, float]:
            return {split: float(values[part].mean()) for split, part in parts.items()}

        mean_distance, bound, hold = mean(distance), mean(self.lower_bound), mean(self.hold_distance)
        gap = {split: (mean_distance[split] - bound[split]) / (hold[split] - bound[split]) for split in SPLITS}
        angles = np.degrees(self._angle_error(rollouts)[parts["train"]].mean(axis=0))
        return {
            "optimality_gap": gap,
            "mean_distance": mean_distance,
            "lower_bound": bound,
            "hold_distance": hold,
            "link_angle_error_deg": float(angles.mean()),
            "link_angle_error_deg_by_link": dict(zip(self.env.learner.link_names, map(float, angles), strict=True)),
            "torque_saturation": float(np.asarray(rollouts.torque_saturation)[parts["train"]].mean()),
        }

    def _angle_error(self, rollouts: Rollouts) -> Float[np.ndarray, "demonstrations links"]:
        """Mean angle [rad] of each learner link to the expert links that correspond to it, by their share in W."""
        env = self.env
        expert = np.asarray(env.expert_states.direction)[:, 1 : env.config.horizon + 1]
        learner = np.asarray(self._learner_states(rollouts.qpos, jnp.zeros_like(rollouts.qpos)).direction)
        cosine = np.einsum("dtix,dtjx->dtij", expert, learner)
        angle = np.arccos(np.clip(cosine, -1, 1)).mean(axis=1)
        return (angle * env.config.metric.shares(env.expert, env.learner)).sum(axis=1)


def _lower_bound(env: ImitationEnv) -> Float[Array, "demonstrations time"]:
    metric, demonstrations = env.config.metric, env.demonstrations

    def bound(qpos: Array, qvel: Array) -> Array:
        return kinematic_bound(
            env.expert,
            env.learner,
            qpos,
            qvel,
            env.correspondence,
            env.weights,
            rotation=metric.rotation_measure,  # type: ignore[arg-type]
            reduction=metric.reduction,  # type: ignore[arg-type]
        )

    after_start = slice(1, env.config.horizon + 1)
    # On the host's processor in any case: there the program compiles several times faster, and it runs once.
    with jax.default_device(jax.devices("cpu")[0]):
        qpos, qvel = (jnp.asarray(x[:, after_start], jnp.float32) for x in (demonstrations.qpos, demonstrations.qvel))
        return jax.jit(jax.vmap(bound))(qpos, qvel)


def _hold_distance(env: ImitationEnv) -> Float[Array, "demonstrations time"]:
    home = jnp.asarray(env.learner.home, jnp.float32)
    steps = jnp.arange(1, env.config.horizon + 1)
    over_time = jax.vmap(lambda demonstration, step: env.distance(home, 0 * home, demonstration, step), (None, 0))
    return jax.jit(jax.vmap(over_time, (0, None)))(jnp.arange(env.demonstrations.count), steps)
