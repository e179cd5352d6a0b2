"""The best achievable rollouts of a run's learner: searches torques of each demonstration, knowing the whole motion.

    python -m benchmarks.searched_torques --run DIR [--iterations 40] [--starts 8] [--out FILE]

Compares the optimality gap with that of the run's policy. Takes minutes.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from brax.envs.base import State
from jaxtyping import Array, Float

from benchmarks.common.parser import make_parser
from benchmarks.common.record import write_results
from benchmarks.common.trajectory_descent import Task, TrajectoryDescent
from mimic.envs.imitation import ImitationEnv, arm_state
from mimic.evaluation.evaluator import Controller, Evaluator, Rollouts
from mimic.evaluation.nearest_pose_controller import ControllerWithMemory
from mimic.evaluation.rollout_metrics import gaps
from mimic.evaluation.tracking_controllers import run_controller
from mimic.physics.step import Load
from mimic.runs.checkpoints import load_checkpoint
from mimic.trainers.make import make_ppo_trainer
from mimic.trainers.run_config import policy_run

_NOISE = 0.3  # standard deviation of the noise on the policy's actions in additional starts
_NOISE_STEPS = 5  # duration of a constant noise, long enough to move the arm off its path
# Control steps that are differentiated at a time, so that they fit into a CPU's cache or the memory of a small GPU.
_CHUNK = {"cpu": 4_000, "gpu": 25_000}

NOISY_POLICY = "noisy_policy"


def search_torques(
    evaluator: Evaluator,
    policy: Controller | ControllerWithMemory,
    iterations: int = 40,
    starts: int = 8,
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
      iterations: number of updates of each torque sequence.
      starts: number of initial sequences for each demonstration: those of the policy, computed_torque, pd and hold in
        this order, then of the policy with noise.

    Returns:
      Rollouts of the best torques; and by name of the start and by split, the optimality gap of the start ("start")
      and of its solution ("found").
    """
    env = evaluator.env
    rollouts_by_start = _starts(evaluator, policy, starts)
    scale = np.asarray(env.torque_scale)
    actions = np.concatenate([np.asarray(start.torque) / scale for start in rollouts_by_start.values()])
    optimised = _descend(evaluator, actions, iterations)
    optimised = optimised.reshape(starts, env.demonstrations.count, *optimised.shape[1:])
    replay = jax.jit(lambda action: evaluator.rollout(_replay(action)))
    solutions = dict(zip(rollouts_by_start, map(replay, optimised), strict=True))
    candidates = *solutions.values(), *rollouts_by_start.values()
    best = np.stack([_objective(env, rollouts) for rollouts in candidates]).argmin(axis=0)
    best_rollouts = jax.tree.map(
        lambda *each: np.stack([np.asarray(x) for x in each])[best, np.arange(len(best))], *candidates
    )
    return best_rollouts, _gaps_by_start(evaluator, rollouts_by_start, solutions)


def _starts(evaluator: Evaluator, policy: Controller | ControllerWithMemory, count: int) -> dict[str, Rollouts]:
    """Rollouts of a number of starts, by name."""
    names = ["policy", "computed_torque", "pd", "hold"]
    names += [f"{NOISY_POLICY}_{i}" for i in range(1, count - len(names) + 1)]
    noisy = jax.jit(lambda key: evaluator.rollout(_with_noise(evaluator.env, policy, key)))

    def make(name: str) -> Rollouts:
        if name == "policy":
            return jax.jit(lambda: evaluator.rollout(policy))()
        if name.startswith(NOISY_POLICY):
            return noisy(jax.random.fold_in(jax.random.PRNGKey(0), names.index(name)))
        return run_controller(evaluator, name)[0]

    return {name: make(name) for name in names[:count]}


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


def _descend(evaluator: Evaluator, action: np.ndarray, iterations: int) -> Float[np.ndarray, "sequences time joints"]:
    """Updates torque sequences, which are ordered by start and then by demonstration."""
    descent = TrajectoryDescent(evaluator.env, _CHUNK["cpu" if jax.default_backend() == "cpu" else "gpu"])
    count = evaluator.env.demonstrations.count
    task = _task(evaluator.env, np.tile(np.arange(count), len(action) // count))
    episodes = descent.start(task, jnp.asarray(action, jnp.float32))
    for done in range(iterations + 1):
        best = np.asarray(episodes.objective).reshape(-1, count).min(axis=0)
        print(f"{done:>4} of {iterations}  objective {np.mean(best):.5f}", flush=True)
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


def main() -> None:
    """Runs the command."""
    parser = make_parser("searched_torques", __doc__, iterations=40, starts=8)
    parser.add_argument("--run", required=True, metavar="DIR", help="run of trainer=ppo with one learner")
    options = parser.parse_args()
    run_dir, trained = policy_run(options.run, None)
    if trained.env.kind != "one_arm" or trained.env.metric.link_distance:
        parser.error("--run: expected one learner, torques as actions and a metric of weighted parts")
    trainer = make_ppo_trainer(trained, Path(run_dir))
    _, params = load_checkpoint(run_dir, trainer.params_template(), None)
    best, starts = search_torques(trainer.evaluator, trainer.controller(params), options.iterations, options.starts)
    gap = trainer.metrics(best)["optimality_gap"]
    write_results(options, iterations=options.iterations, optimality_gap=gap, starts=starts)
    print("gap: " + ", ".join(f"{split} {value:.2%}" for split, value in gap.items()))


if __name__ == "__main__":
    main()
