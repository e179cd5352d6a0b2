"""Model predictive control: torques that minimise the metric over the expert's next steps, by iLQR."""

import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from brax.envs.base import State
from jaxtyping import Array, Float

from mimic.envs.arm_state import arm_state
from mimic.envs.imitation import ImitationEnv
from mimic.evaluation.nearest_pose_controller import ControllerWithMemory
from mimic.metric.kinematics import LinkStates, link_states
from mimic.physics import dynamics
from mimic.physics.joint_numbers import joints_of_model
from mimic.physics.step import runge_kutta

EXTRAPOLATED = 4  # steps after the preview, in which the expert is assumed to move on with its velocities
_SUBSTEPS = 2  # of the model in a control step
_ITERATIONS = 4  # from the last step's torques, moved on by a step
_TRUST = 0.3  # in an extrapolated step, as a factor on the weight of the step before
_EFFORT = 1e-5  # weight of a squared action; the metric has no weight for torques
DAMPING = 1e-4  # added to the curvature by actions
_LINE_SEARCH = (1.0, 0.5, 0.2, 0.05, 0.0)  # fractions of a step

Advance = Callable[[Array, Array], Array]  # (angles and velocities, action) -> those after a step
Cost = Callable[[Array, LinkStates], Array]  # (angles and velocities, expert) -> distance


def predictive_controller(env: ImitationEnv) -> ControllerWithMemory:
    """A controller with the information of a policy: the expert within the preview, and the arm's nominal model.

    At each step it improves the torques of the next `preview` + 4 steps by iLQR: the dynamics are linearised, the
    metric is replaced by its second-order expansion without negative curvature, and a line search keeps the best
    torques, which are cut at their limits. The first of them acts. The linear-quadratic step and the line search are
    those of Tassa et al., "Synthesis and stabilization of complex behaviors through online trajectory optimization",
    2012; their box constraints are replaced by cutting.

    Args:
      env: the environment; its actions are torques, and its metric is differentiable twice.
    """
    preview, dt = env.config.preview, env.config.control_dt
    advance, cost = problem(env, _SUBSTEPS)
    horizon = preview + EXTRAPOLATED
    trust = _TRUST ** jnp.maximum(0, jnp.arange(horizon) - preview + 1.0)

    def start(state: State) -> Float[Array, "steps joints"]:
        return jnp.zeros((horizon, env.learner.num_joints))

    def act(state: State, actions: Array) -> tuple[Array, Array]:
        arm = arm_state(state)
        known = jax.vmap(env.expert_at, (None, 0))(arm.demonstration, arm.step + jnp.arange(preview + 1))
        expert = ahead(known, dt)
        first = jnp.concatenate([arm.qpos, arm.qvel])
        improve = functools.partial(improved, advance, cost, first, expert, trust, DAMPING)
        actions = jnp.concatenate([actions[1:], actions[-1:]])
        actions, _ = jax.lax.scan(lambda x, _: (improve(x), None), actions, None, length=_ITERATIONS)
        return actions[0], actions

    return ControllerWithMemory(start, act)


def problem(env: ImitationEnv, substeps: int) -> tuple[Advance, Cost]:
    """The nominal dynamics of a control step, and the distance after it.

    Args:
      env: the environment.
      substeps: steps of the model in a control step; those of the environment simulate what it does.
    """
    joints, model = env.learner.num_joints, joints_of_model(env.arm.model)
    timestep = env.config.control_dt / substeps

    def advance(state: Array, action: Array) -> Array:
        torque = list(action * env.torque_scale)

        def acceleration(qpos: Array, qvel: Array) -> Array:
            return jnp.stack(dynamics.acceleration(model, list(qpos), list(qvel), torque))

        return jnp.concatenate(runge_kutta(acceleration, state[:joints], state[joints:], timestep, substeps))

    def cost(state: Array, expert: LinkStates) -> Array:
        return env.states_distance(expert, link_states(env.learner, state[:joints], state[joints:]))

    return advance, cost


def ahead(known: LinkStates, dt: float) -> LinkStates:
    """The expert after each of the next steps: those known, then moved on with the velocities of the last one."""
    time = dt * jnp.arange(1, EXTRAPOLATED + 1)[:, None, None]
    last = jax.tree.map(lambda x: x[-1:], known)

    def turned(axes: Array, angular_velocity: Array) -> Array:
        moved = axes + time * jnp.cross(angular_velocity, axes)
        return moved / jnp.sqrt(jnp.sum(moved**2, axis=-1, keepdims=True))

    later = jax.tree.map(lambda x: jnp.repeat(x, EXTRAPOLATED, axis=0), last)
    later = later.replace(position=last.position + time * last.linear_velocity)
    if last.direction is not None:
        later = later.replace(direction=turned(last.direction, last.angular_velocity))
    if last.hand is not None:
        omega = jnp.repeat(last.hand.angular_velocity, 3, axis=-2)
        later = later.replace(hand=later.hand.replace(axes=turned(last.hand.axes, omega)))
    return jax.tree.map(lambda x, y: jnp.concatenate([x[1:], y]), known, later)


@jax.default_matmul_precision("highest")  # not TF32
def improved(
    advance: Advance,
    cost: Cost,
    first: Float[Array, " states"],
    expert: LinkStates,
    trust: Float[Array, " steps"],
    damping: float | Float[Array, ""],
    actions: Float[Array, "steps joints"],
) -> Float[Array, "steps joints"]:
    """Actions after one iteration of iLQR; the same ones where none are better.

    Args:
      advance: see `problem`.
      cost: likewise.
      first: angles and velocities before the first step.
      expert: [steps, links, 3] each, after each step.
      trust: weight of each step.
      damping: added to the curvature by actions.
      actions: before.
    """

    def roll(actions: Array) -> Array:
        return jax.lax.scan(lambda x, u: (advance(x, u), x), first, actions)[1]

    before = roll(actions)
    slopes = jax.vmap(jax.jacfwd(advance, argnums=(0, 1)))(before, actions)
    after = jax.vmap(advance)(before, actions)
    gradients = trust[:, None] * jax.vmap(jax.grad(cost))(after, expert)
    curvatures = trust[:, None, None] * _without_negative(jax.vmap(jax.hessian(cost))(after, expert))

    def backward(value: tuple[Array, Array], step: Any) -> tuple[tuple[Array, Array], tuple[Array, Array]]:
        (by_state, by_action), gradient, curvature, action = step
        gradient, curvature = gradient + value[0], curvature + value[1]  # by the state after the step
        of_action = by_action.T @ gradient + 2 * _EFFORT * action
        matrix = by_action.T @ curvature @ by_action + (2 * _EFFORT + damping) * jnp.eye(len(action))
        mixed = by_action.T @ curvature @ by_state
        gains = -jnp.linalg.solve(matrix, jnp.column_stack([mixed, of_action]))
        feedback, change = gains[:, :-1], gains[:, -1]
        gradient = by_state.T @ gradient + mixed.T @ change
        curvature = by_state.T @ curvature @ by_state + mixed.T @ feedback
        return (gradient, (curvature + curvature.T) / 2), (feedback, change)

    nothing = jnp.zeros_like(first), jnp.zeros((len(first), len(first)))
    steps = (slopes, gradients, curvatures, actions)
    _, (feedback, change) = jax.lax.scan(backward, nothing, steps, reverse=True)

    def attempt(fraction: Array) -> tuple[Array, Array]:
        def forward(state: Array, step: Any) -> tuple[Array, tuple[Array, Array]]:
            action, gain, difference, planned, shown, weight = step
            chosen = jnp.clip(action + fraction * difference + gain @ (state - planned), -1.0, 1.0)
            state = advance(state, chosen)
            return state, (chosen, weight * cost(state, shown) + _EFFORT * jnp.sum(chosen**2))

        _, (chosen, costs) = jax.lax.scan(forward, first, (actions, feedback, change, before, expert, trust))
        return chosen, costs.sum()

    candidates, totals = jax.vmap(attempt)(jnp.asarray(_LINE_SEARCH))
    totals = jnp.where(jnp.isfinite(totals), totals, jnp.inf)  # stiff arms can diverge in the model's few substeps
    return jnp.where(jnp.isfinite(totals).any(), candidates[jnp.argmin(totals)], actions)


def _without_negative(matrices: Float[Array, "steps n n"]) -> Float[Array, "steps n n"]:
    """The nearest matrices without negative eigenvalues."""
    values, vectors = jnp.linalg.eigh(matrices)
    return jnp.einsum("sij,sj,skj->sik", vectors, jnp.maximum(values, 0.0), vectors)
