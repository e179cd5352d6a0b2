"""Descent of open-loop torques through the physics: a damped Gauss-Newton method over a whole episode.

Differential dynamic programming with bounds on the torque (Tassa, Mansard, Todorov, "Control-Limited Differential
Dynamic Programming", ICRA 2014), with first derivatives of the dynamics only ("iLQR"). A plain gradient through 50
control steps is badly conditioned. Here each update is a feedback law around the last rollout, which keeps the arm near
it. Only one control step is differentiated, in forward mode, so that it compiles in seconds.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from mimic.envs.imitation import ImitationEnv, limit_excess
from mimic.metric.distance import PARTS, PairDistances, Weights, pair_distances
from mimic.metric.kinematics import LinkStates, link_states
from mimic.physics.step import Load, make_advance

_STEPS = (1.0, 0.5, 0.2, 0.05, 0.01)  # fractions of the full update; all are rolled out, and the best is used
_DAMPING, _MIN_DAMPING, _MAX_DAMPING = 1e-2, 1e-6, 1e3  # added to the curvature with respect to the action
_LESS, _MORE = 0.3, 4.0  # factors on the damping after a full update, and after a rejected update
_ACTIVE_SETS = 4  # iterations that identify the actions at their bounds
# A norm |r| has curvature 1 / |r| across r, which is infinite at a match. So |r| is at least this, in the units of
# `PairDistances`.
_MIN_NORM = {"translation": 1e-3, "linear_velocity": 1e-2, "angular_velocity": 1e-2}
_FIELDS = {
    "translation": "position",
    "rotation": "direction",
    "linear_velocity": "linear_velocity",
    "angular_velocity": "angular_velocity",
}


class Episodes(NamedTuple):
    """A batch of torque sequences and their rollouts.

    Attributes:
      action: [sequences, T, joints] torque as a fraction of the maximum, in [-1, 1].
      qpos: [sequences, T + 1, joints] joint angles at the start and after each step [rad].
      qvel: [sequences, T + 1, joints] joint velocities [rad/s].
      objective: [sequences] mean over time of distance and limit penalty; infinite for runaways.
      damping: [sequences] of the next update.
    """

    action: Float[Array, "sequences time joints"]
    qpos: Float[Array, "sequences samples joints"]
    qvel: Float[Array, "sequences samples joints"]
    objective: Float[Array, " sequences"]
    damping: Float[Array, " sequences"]


class Task(NamedTuple):
    """The expert's motion, the learner's load and its start pose of each sequence.

    Attributes:
      expert: link states after each step, [sequences, T, links, 3] each.
      load: factors on mass and damping of the learner, [sequences] each.
      start: [sequences, joints] joint angles at the start, which is at rest [rad].
    """

    expert: LinkStates
    load: Load
    start: Float[np.ndarray, "sequences joints"]


class _Model(NamedTuple):
    """Linear model of the dynamics and quadratic model of the objective around the rollout of one sequence.

    Attributes:
      by_state: [T, 2 joints, 2 joints] derivative of the joint state after a step by that before.
      by_action: [T, 2 joints, joints] derivative of the joint state after a step by the action.
      gradient: [T, 2 joints] of the step's objective by the joint state after the step.
      curvature: [T, 2 joints, 2 joints] of the same, positive semidefinite.
    """

    by_state: Array
    by_action: Array
    gradient: Array
    curvature: Array


class TrajectoryDescent:
    """Descent of the objective for the learner of an environment, always in "fused" physics.

    Args:
      env: the environment.
      chunk: number of control steps that are differentiated at a time; it bounds the memory.
    """

    def __init__(self, env: ImitationEnv, chunk: int):
        config = env.config
        self._env, self._chunk = env, chunk
        self._advance = make_advance(env.arm.model, config.control_dt / config.substeps, config.substeps, "fused")
        self.start = jax.jit(self._start)
        self.improve = jax.jit(jax.default_matmul_precision("highest")(self._improve))

    def _start(self, task: Task, action: Float[Array, "sequences time joints"]) -> Episodes:
        """Rolls out sequences."""
        action = jnp.clip(action, -1.0, 1.0)
        over_time = jnp.swapaxes(action, 0, 1)
        qpos, qvel, _ = self._rollout(task, lambda now, qpos, qvel: now, over_time)
        objective = self._objective(task, qpos, qvel)
        return Episodes(action, qpos, qvel, objective, jnp.full(len(action), _DAMPING, action.dtype))

    def _improve(self, task: Task, episodes: Episodes) -> Episodes:
        """Updates each sequence once; a sequence that would get worse stays, with more damping."""
        count = len(episodes.action)
        model = self._linearize(task, episodes)
        change, gain = jax.vmap(_backward)(model, episodes.action, episodes.damping)
        sizes = jnp.asarray(_STEPS, change.dtype)
        repeated_task = jax.tree.map(lambda x: jnp.concatenate([x] * len(_STEPS)), task)

        def law(now: Any, qpos: Array, qvel: Array) -> Array:
            action, change, gain, old = now
            state = jnp.concatenate([qpos, qvel], axis=-1).reshape(len(_STEPS), count, -1)
            correction = jnp.sum(gain * (state - old)[..., None, :], axis=-1)
            new = action + sizes[:, None, None] * change + correction
            return jnp.clip(new, -1.0, 1.0).reshape(len(_STEPS) * count, -1)

        old = jnp.concatenate([episodes.qpos, episodes.qvel], axis=-1)[:, :-1]
        over_time = jax.tree.map(lambda x: jnp.swapaxes(x, 0, 1), (episodes.action, change, gain, old))
        qpos, qvel, action = self._rollout(repeated_task, law, over_time)
        objective = self._objective(repeated_task, qpos, qvel).reshape(len(_STEPS), count)
        best = jnp.argmin(objective, axis=0)  # the objective is never NaN

        def of_best(x: Array) -> Array:
            return x.reshape(len(_STEPS), count, *x.shape[1:])[best, jnp.arange(count)]

        best_objective = jnp.min(objective, axis=0)
        better = best_objective < episodes.objective
        factor = jnp.where(better, jnp.where(best == 0, _LESS, 1.0), _MORE)
        damping = jnp.clip(episodes.damping * factor, _MIN_DAMPING, _MAX_DAMPING)
        new = Episodes(of_best(action), of_best(qpos), of_best(qvel), best_objective, damping)
        kept = episodes._replace(damping=damping)
        return jax.tree.map(lambda x, y: jnp.where(better.reshape(-1, *[1] * (x.ndim - 1)), x, y), new, kept)

    def _rollout(self, task: Task, law: Callable[..., Array], over_time: Any) -> tuple[Array, Array, Array]:
        """Joint states [count, T + 1, joints] and actions [count, T, joints] of a law (now, qpos, qvel) -> action."""

        def step(state: tuple[Array, Array], now: Any) -> tuple[tuple[Array, Array], Any]:
            action = law(now, *state)
            state = jax.vmap(self._advance)(*state, action * self._env.torque_scale, task.load)
            return state, (*state, action)

        start = jnp.asarray(task.start, jnp.float32), jnp.zeros(task.start.shape, jnp.float32)
        _, (qpos, qvel, action) = jax.lax.scan(step, start, over_time)
        qpos, qvel = (jnp.concatenate([first[None], x]) for first, x in zip(start, (qpos, qvel), strict=True))
        return jnp.swapaxes(qpos, 0, 1), jnp.swapaxes(qvel, 0, 1), jnp.swapaxes(action, 0, 1)

    def _objective(self, task: Task, qpos: Array, qvel: Array) -> Float[Array, " sequences"]:
        def at(expert: LinkStates, qpos: Array, qvel: Array) -> Array:
            return self._distance(expert, link_states(self._env.learner, qpos, qvel)) + self._penalty(qpos, qvel)

        def of_sequence(expert: LinkStates, qpos: Array, qvel: Array) -> Array:
            mean = jnp.mean(jax.vmap(at)(expert, qpos[1:], qvel[1:]))
            safe = jnp.all(jnp.abs(qvel) < self._env.config.speed_bound) & jnp.isfinite(mean)
            return jnp.where(safe, mean, jnp.inf)

        return jax.vmap(of_sequence)(task.expert, qpos, qvel)

    def _distance(self, expert: LinkStates, learner: LinkStates) -> Array:
        return self._env.states_distance(expert, learner)

    def _penalty(self, qpos: Array, qvel: Array) -> Array:
        weight = self._env.limit_penalty_weight
        return weight * limit_excess(self._env.learner, qpos, qvel) if weight else jnp.zeros(())

    def _linearize(self, task: Task, episodes: Episodes) -> _Model:
        """Models of all sequences, computed a few sequences at a time."""
        count, horizon = episodes.action.shape[:2]
        rounds = min(-(-count * horizon // self._chunk), count)
        size = -(-count // rounds)
        # All rounds have the same size and the last one is padded, because a smaller one would compile separately.
        rows = jnp.minimum(jnp.arange(rounds * size), count - 1)
        padded = jax.tree.map(lambda x: x[rows], (task, episodes))
        model = jax.lax.map(lambda sequence: self._linearized(*sequence), padded, batch_size=size)
        return jax.tree.map(lambda x: x[:count], model)

    def _linearized(self, task: Task, episodes: Episodes) -> _Model:
        """The model of one sequence."""
        joints = self._env.action_size

        def step(state: Array, action: Array) -> Array:
            after = self._advance(state[:joints], state[joints:], action * self._env.torque_scale, task.load)
            return jnp.concatenate(after)

        state = jnp.concatenate([episodes.qpos, episodes.qvel], axis=-1)
        by_state, by_action = jax.vmap(jax.jacfwd(step, (0, 1)))(state[:-1], episodes.action)
        gradient, curvature = jax.vmap(self._quadratic)(task.expert, state[1:])
        return _Model(by_state, by_action, gradient, curvature)

    def _quadratic(self, expert: LinkStates, state: Float[Array, " states"]) -> tuple[Array, Array]:
        """Gradient and Gauss-Newton curvature of a step's objective by the joint state."""
        joints, learner = self._env.action_size, self._env.learner

        def states_of(state: Array) -> LinkStates:
            return link_states(learner, state[:joints], state[joints:])

        states, jacobian = states_of(state), jax.jacfwd(states_of)(state)
        by_link = jax.grad(self._distance, argnums=1)(expert, states)
        gradient = jax.grad(lambda state: self._penalty(state[:joints], state[joints:]))(state)
        curvature = jnp.zeros((2 * joints, 2 * joints), state.dtype)
        for part, weight in self._link_curvature(expert, states).items():
            field = _FIELDS[part]
            rows = getattr(jacobian, field).reshape(-1, 2 * joints)
            gradient = gradient + getattr(by_link, field).ravel() @ rows
            curvature = curvature + (rows * jnp.repeat(weight, 3)[:, None]).T @ rows
        return gradient, curvature

    def _link_curvature(self, expert: LinkStates, learner: LinkStates) -> dict[str, Float[Array, " links"]]:
        """Curvature of the distance by each part of each learner link's state.

        For a norm |r| with weight w in the distance it is w / |r|, the curvature of the parabola that touches the norm
        at r and is an upper bound, as in iteratively reweighted least squares. For (pi/4) |e - e_hat|^2 it is the exact
        curvature, w pi/2. For adaptive weights or a soft correspondence, w follows from differentiation.
        """
        measure: Any = self._env.config.metric.rotation_measure
        over_learner = jax.vmap(lambda a, b: pair_distances(a, b, measure), in_axes=(None, 0))
        parts = jax.vmap(over_learner, in_axes=(0, None))(expert, learner)
        weights = jax.grad(self._of_parts)(parts)
        curvature = {}
        for part in PARTS:
            if part == "rotation":
                rate: Any = 0.5 * jnp.pi
            else:
                rate = 1 / jnp.maximum(getattr(parts, part), _MIN_NORM[part])
            curvature[part] = jnp.sum(jnp.maximum(getattr(weights, part), 0) * rate, axis=0)
        return curvature

    def _of_parts(self, parts: PairDistances) -> Array:
        """The embodiment distance as a function of the parts of its pair distances."""
        metric = self._env.metric
        alpha = _weights_at(metric.weights, parts)
        return metric.reduced(sum((getattr(alpha, part) * getattr(parts, part) for part in PARTS), jnp.zeros(())))


def _weights_at(weights: Weights, parts: PairDistances) -> Any:
    return jax.vmap(jax.vmap(weights))(parts) if callable(weights) else weights


def _backward(model: _Model, action: Array, damping: Array) -> tuple[Array, Array]:
    """Change of each action [T, joints] and its feedback on the joint state [T, joints, 2 joints]; of one sequence."""

    def step(value: tuple[Array, Array], now: tuple[_Model, Array]) -> tuple[tuple[Array, Array], tuple[Array, Array]]:
        at, action = now
        # Of the objective from this step on, by the joint state after the step.
        gradient, curvature = value[0] + at.gradient, value[1] + at.curvature
        by_action, by_state = at.by_action.T @ gradient, at.by_state.T @ gradient
        across = at.by_action.T @ curvature
        action_curvature, mixed = across @ at.by_action, across @ at.by_state
        damped = action_curvature + damping * jnp.eye(len(action), dtype=action.dtype)
        change, gain = _bounded_law(damped, by_action, mixed, -1.0 - action, 1.0 - action)
        gradient = by_state + gain.T @ (action_curvature @ change + by_action) + mixed.T @ change
        curvature = (
            at.by_state.T @ curvature @ at.by_state + gain.T @ action_curvature @ gain + gain.T @ mixed + mixed.T @ gain
        )
        return (gradient, 0.5 * (curvature + curvature.T)), (change, gain)

    zero = jnp.zeros_like(model.gradient[0]), jnp.zeros_like(model.curvature[0])
    _, law = jax.lax.scan(step, zero, (model, action), reverse=True)
    return law


def _bounded_law(
    matrix: Array, gradient: Array, mixed: Array, lower: Array, upper: Array
) -> tuple[Float[Array, " joints"], Float[Array, "joints states"]]:
    """Minimum of x.matrix.x / 2 + gradient.x between bounds, and its derivative by a state that enters by `mixed`.

    Newton iterations on the components that are not at a bound (Bertsekas, "Projected Newton Methods", 1982). The
    derivative of a component at a bound is zero.
    """
    identity = jnp.eye(len(gradient), dtype=gradient.dtype)
    change = jnp.zeros_like(gradient)
    for _ in range(_ACTIVE_SETS):
        slope_at_change = gradient + matrix @ change
        at_bound = ((change <= lower) & (slope_at_change > 0)) | ((change >= upper) & (slope_at_change < 0))
        free = ~at_bound
        kept = jnp.where(free, 0.0, change)
        reduced = jnp.where(free[:, None] & free[None, :], matrix, identity)
        sides = jnp.concatenate([(gradient + matrix @ kept)[:, None], mixed], axis=1)
        factor = jax.scipy.linalg.cho_factor(reduced)
        solution = -jax.scipy.linalg.cho_solve(factor, jnp.where(free[:, None], sides, 0.0))
        change, gain = jnp.clip(jnp.where(free, solution[:, 0], kept), lower, upper), solution[:, 1:]
    return change, gain
