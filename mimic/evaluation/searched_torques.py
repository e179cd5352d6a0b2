"""Estimates the best achievable rollouts: optimises the torques of each demonstration, knowing the whole motion."""

from collections.abc import Callable, Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from brax.envs.base import State
from jaxtyping import Array, Float

from mimic.envs.imitation import ImitationEnv, arm_state
from mimic.evaluation.config import SearchConfig
from mimic.evaluation.evaluator import Controller, Evaluator, Rollouts
from mimic.evaluation.nearest_pose_controller import ControllerWithMemory
from mimic.evaluation.rollout_metrics import gaps
from mimic.evaluation.tracking_controllers import run_controller
from mimic.evaluation.trajectory_descent import Task, TrajectoryDescent
from mimic.physics.step import Load

_NOISE = 0.3  # standard deviation of the noise on the policy's actions in additional starts
_NOISE_STEPS = 5  # duration of a constant noise, long enough to move the arm off its path
# Control steps that are differentiated at a time, so that they fit into a CPU's cache or the memory of a small GPU.
_CHUNK = {"cpu": 4_000, "gpu": 25_000}

NOISY_POLICY = "noisy_policy"


def search_torques(
    evaluator: Evaluator,
    policy: Controller | ControllerWithMemory,
    config: SearchConfig,
    on_update: Callable[[int, str], None],
) -> tuple[Rollouts, dict[str, dict[str, dict[str, float]]]]:
    """Optimises torques for each demonstration, by descent from several starts.

    A start is the torque sequence of a policy, of a controller (see `run_controller`), or of the policy with noise on
    its actions. `TrajectoryDescent` improves each in "fused" physics; the solution is rolled out open loop in the
    environment's physics. For each demonstration the best of all starts and solutions is returned, so that the result
    is never worse than the best start. The objective is that of the reward: distance and limit penalty.

    The result is no bound: a better local minimum may exist.

    Args:
      evaluator: evaluator of the environment and its demonstrations.
      policy: controller of the first start.
      config: see `SearchConfig`.
      on_update: called with the number of updates, from 0 on, and the objective as text.

    Returns:
      Rollouts of the best torques; and by name of the start and by split, the optimality gap of the start ("start")
      and of its solution ("found").
    """
    env = evaluator.env
    starts = _starts(evaluator, policy, config)
    scale = np.asarray(env.torque_scale)
    actions = np.concatenate([np.asarray(start.torque) / scale for start in starts.values()])
    optimised = _descend(evaluator, actions, config.iterations, on_update)
    optimised = optimised.reshape(len(starts), env.demonstrations.count, *optimised.shape[1:])
    replay = jax.jit(lambda action: evaluator.rollout(_replay(action)))
    solutions = dict(zip(starts, map(replay, optimised), strict=True))
    candidates = *solutions.values(), *starts.values()
    best = np.stack([_objective(env, rollouts) for rollouts in candidates]).argmin(axis=0)
    best_rollouts = jax.tree.map(
        lambda *each: np.stack([np.asarray(x) for x in each])[best, np.arange(len(best))], *candidates
    )
    return best_rollouts, _gaps_by_start(evaluator, starts, solutions)


def _starts(
    evaluator: Evaluator, policy: Controller | ControllerWithMemory, config: SearchConfig
) -> dict[str, Rollouts]:
    """Rollouts of `config.starts` starts, by name."""
    names = ["policy", "computed_torque", "pd", "hold"]
    names += [f"{NOISY_POLICY}_{i}" for i in range(1, config.starts - len(names) + 1)]
    noisy = jax.jit(lambda key: evaluator.rollout(_with_noise(evaluator.env, policy, key)))

    def make(name: str) -> Rollouts:
        if name == "policy":
            return jax.jit(lambda: evaluator.rollout(policy))()
        if name.startswith(NOISY_POLICY):
            return noisy(jax.random.fold_in(jax.random.PRNGKey(0), names.index(name)))
        return run_controller(evaluator, name)[0]

    return {name: make(name) for name in names[: config.starts]}


def _with_noise(
    env: ImitationEnv, policy: Controller | ControllerWithMemory, key: Array
) -> Controller | ControllerWithMemory:
    shape = env.demonstrations.count, env.config.horizon, env.action_size
    noise = jnp.repeat(_NOISE * jax.random.normal(key, shape), _NOISE_STEPS, axis=1)

    def noise_at(state: State) -> Array:
        arm = arm_state(state)
        return noise[arm.demonstration, arm.step]

    if not isinstance(policy, ControllerWithMemory):
        return lambda state: policy(state) + noise_at(state)
    with_memory = policy

    def act(state: State, memory: Any) -> tuple[Array, Any]:
        action, memory = with_memory.act(state, memory)
        return action + noise_at(state), memory

    return with_memory._replace(act=act)


def _replay(action: Float[Array, "demonstrations time joints"]) -> Controller:
    """An open-loop controller."""

    def controller(state: State) -> Array:
        arm = arm_state(state)
        return action[arm.demonstration, arm.step]

    return controller


def _descend(
    evaluator: Evaluator, action: np.ndarray, iterations: int, on_update: Callable[[int, str], None]
) -> Float[np.ndarray, "sequences time joints"]:
    """Updates torque sequences, which are ordered by start and then by demonstration."""
    descent = TrajectoryDescent(evaluator.env, _CHUNK["cpu" if jax.default_backend() == "cpu" else "gpu"])
    count = evaluator.env.demonstrations.count
    task = _task(evaluator.env, np.tile(np.arange(count), len(action) // count))
    episodes = descent.start(task, jnp.asarray(action, jnp.float32))
    for done in range(iterations + 1):
        best = np.asarray(episodes.objective).reshape(-1, count).min(axis=0)
        on_update(done, f"objective {np.mean(best):.5f}")
        if done < iterations:
            episodes = descent.improve(task, episodes)
    return np.asarray(episodes.action)


def _task(env: ImitationEnv, demonstrations: np.ndarray) -> Task:
    """The task of each sequence, with the same loads as in `Evaluator.rollout` but without noise on torques."""

    def load(demonstration: Array) -> Load | None:
        return env.start(jax.random.fold_in(jax.random.PRNGKey(0), demonstration), demonstration).load

    loads = jax.vmap(load)(jnp.asarray(demonstrations))
    if loads is None:
        constant = env.config.randomization
        loads = Load(*(jnp.full(len(demonstrations), factor[0]) for factor in (constant.mass, constant.damping)))
    expert = jax.tree.map(lambda table: table[demonstrations, 1 : env.config.horizon + 1], env.expert_states)
    return Task(expert, loads, env.start_poses[demonstrations])


def _objective(env: ImitationEnv, rollouts: Rollouts) -> Float[np.ndarray, " demonstrations"]:
    """Mean over time of distance and limit penalty; infinite instead of NaN."""
    value = np.asarray(rollouts.distance)
    if env.limit_penalty_weight:
        excess = jax.jit(jax.vmap(jax.vmap(env.limit_excess)))(rollouts.qpos, rollouts.qvel)
        value = value + env.limit_penalty_weight * np.asarray(excess)
    return np.nan_to_num(value.mean(axis=1), nan=np.inf)


def _gaps_by_start(
    evaluator: Evaluator, starts: Mapping[str, Rollouts], solutions: Mapping[str, Rollouts]
) -> dict[str, dict[str, dict[str, float]]]:
    def gap(rollouts: Rollouts) -> dict[str, float]:
        curves = np.asarray(rollouts.distance), evaluator.lower_bound, evaluator.hold_distance
        return {
            name: float(gaps(*(x[part].mean(dtype=float) for x in curves))) for name, part in evaluator.parts.items()
        }

    return {name: {"start": gap(starts[name]), "found": gap(solutions[name])} for name in starts}
