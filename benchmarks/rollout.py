"""Simulation speed: steps per second of the physics, of whole environment steps, and of their parts.

    python -m benchmarks.rollout --out FILE [--envs panda7dof ...] [--arms 64 512 ...] [--peer-arms 512 ...]
                                [--cases fused MJX-Warp ...]

Every case makes control steps of 0.1 s under random torques, with the environment's own 10 Runge-Kutta steps of 10 ms.
The physics of the environments, `fused` and `mjx`, is compared with a loop that carries `mjx.Data`, as is usual,
MJX-Warp, where it is installed, and C MuJoCo's threaded rollout on the CPU. Environment steps add the reward, the
observation and new episodes; the stock environment carries and resets `mjx.Data`, as brax environments usually do, with
our reward. Times are medians with quartiles, without compilation.
"""

import os
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import mujoco.rollout
import numpy as np
from brax.envs.base import Wrapper
from mujoco import mjx
from rich.console import Console
from rich.progress import track

import mimic
from benchmarks.common.parser import BenchmarkParser
from benchmarks.common.record import Results, Row, failure, print_table
from benchmarks.common.timing import Timing, time_call, time_program
from benchmarks.peers import stock
from mimic.envs.imitation import ImitationEnv
from mimic.envs.physics import Load, make_advance
from mimic.envs.wrappers import wrap_for_training

ENVS = ("panda7dof", "panda4dof", "panda3dof")
ARMS = (64, 512, 4096, 8192, 32768, 65536, 131072)
PEER_ARMS = (512, 8192, 65536)  # for cases that are slow to compile and to run
STEPS = 10  # control steps in a call

Case = Callable[[ImitationEnv, int], Timing]


def random_motion(env: ImitationEnv, arms: int) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Joint states of the arms, and a torque for each control step."""
    key_qpos, key_torque = jax.random.split(jax.random.PRNGKey(0))
    qpos = env.learner.home + jax.random.uniform(key_qpos, (arms, env.action_size), minval=-1.0, maxval=1.0)
    actions = jax.random.uniform(key_torque, (STEPS, arms, env.action_size), minval=-1.0, maxval=1.0)
    return qpos, jnp.zeros_like(qpos), 0.1 * actions * env.torque_scale


def own_physics(physics: str) -> Case:
    """The physics of the environments, which carries joint states alone."""

    def case(env: ImitationEnv, arms: int) -> Timing:
        substeps = env.config.substeps
        advance = make_advance(env.arm.model, env.config.control_dt / substeps, substeps, physics)

        def step(state: Any, torque: jax.Array) -> Any:
            return jax.vmap(lambda q, v, held: advance(q, v, held, Load()))(*state, torque), None

        return time_program(lambda q, v, torques: jax.lax.scan(step, (q, v), torques)[0], *random_motion(env, arms))

    return case


def carried_data(implementation: str) -> Case:
    """`mjx.step`, from one `mjx.Data` to the next."""

    def case(env: ImitationEnv, arms: int) -> Timing:
        model = stock.model_with_substeps(env)
        mjx_model, blank = (make(model, impl=implementation) for make in (mjx.put_model, mjx.make_data))
        qpos, qvel, torques = random_motion(env, arms)
        data = jax.vmap(lambda q, v: blank.replace(qpos=q, qvel=v))(qpos, qvel)

        def step(data: Any, torque: jax.Array) -> Any:
            data = data.replace(qfrc_applied=torque)
            substep = jax.vmap(lambda d: mjx.step(mjx_model, d))
            return jax.lax.fori_loop(0, env.config.substeps, lambda _, d: substep(d), data), None

        return time_program(lambda d, t: jax.lax.scan(step, d, t)[0], data, torques)

    return case


def mujoco_threads(env: ImitationEnv, arms: int) -> Timing:
    """C MuJoCo on all cores of the CPU."""
    model = stock.model_with_substeps(env)
    threads = [mujoco.MjData(model) for _ in range(os.cpu_count() or 1)]
    qpos, qvel, torques = (np.asarray(x, float) for x in random_motion(env, arms))
    state = np.hstack([np.zeros((arms, 1)), qpos, qvel])  # time is first
    control = np.repeat(torques.swapaxes(0, 1), env.config.substeps, axis=1)
    applied = int(mujoco.mjtState.mjSTATE_QFRC_APPLIED)
    with mujoco.rollout.Rollout(nthread=len(threads)) as pool:
        return time_call(lambda: pool.rollout(model, threads, state, control, control_spec=applied))


def environment(physics: str) -> Case:
    """A whole environment step as PPO makes it, with new episodes."""

    def case(env: ImitationEnv, arms: int) -> Timing:
        env = env if physics == env.config.physics else mimic.make(env.config.name, physics=physics)
        return _steps(wrap_for_training(env, env.config.horizon + 1), env.action_size, arms)

    return case


def stock_environment(env: ImitationEnv, arms: int) -> Timing:
    """The same task as brax environments usually implement it: `mjx.Data` is carried, and reset to its first value."""
    return _steps(stock.wrap(stock.StockEnv(env), env.config.horizon + 1), env.action_size, arms)


def _steps(wrapped: Wrapper, action_size: int, arms: int) -> Timing:
    state = jax.jit(wrapped.reset)(jax.random.split(jax.random.PRNGKey(0), arms))
    actions = jax.random.uniform(jax.random.PRNGKey(1), (STEPS, arms, action_size), minval=-1.0, maxval=1.0)

    def step(state: Any, action: jax.Array) -> Any:
        state = wrapped.step(state, action)
        return state, (state.reward, jnp.sum(state.obs, axis=-1))  # uses all of the observation, and stores little

    return time_program(lambda s, a: jax.lax.scan(step, s, a), state, actions)


def _reward(env: ImitationEnv, state: Any) -> jax.Array:
    return env.distance(state.qpos, state.qvel, state.demonstration, state.step)


def _observation(env: ImitationEnv, state: Any) -> jax.Array:
    return jnp.sum(env.observe(state))


def _new_episode(env: ImitationEnv, state: Any) -> jax.Array:
    fresh = env.start(state.key)
    return jnp.sum(fresh.qpos) + fresh.demonstration + fresh.key[0]


def part(function: Callable[[ImitationEnv, Any], jax.Array]) -> Case:
    """One part of the environment step alone."""

    def case(env: ImitationEnv, arms: int) -> Timing:
        qpos, qvel, torques = random_motion(env, arms)
        started = jax.jit(jax.vmap(env.start))(jax.random.split(jax.random.PRNGKey(0), arms))

        def step(state: Any, torque: jax.Array) -> Any:
            state = state.replace(qpos=state.qpos + 1e-3 * torque, step=state.step + 1)
            return state, jax.vmap(lambda arm: function(env, arm))(state)

        return time_program(lambda s, t: jax.lax.scan(step, s, t), started.replace(qpos=qpos, qvel=qvel), torques)

    return case


CASES: dict[str, dict[str, Case]] = {
    "physics": {
        "fused": own_physics("fused"),
        "mjx": own_physics("mjx"),
        "mjx.Data carried": carried_data("jax"),
        "MJX-Warp": carried_data("warp"),
        "C MuJoCo, all cores": mujoco_threads,
    },
    "environment": {"fused": environment("fused"), "mjx": environment("mjx"), "stock": stock_environment},
    "part": {"reward": part(_reward), "observation": part(_observation), "new episode": part(_new_episode)},
}
NAMES = tuple(dict.fromkeys(case for cases in CASES.values() for case in cases))
OWN = {("physics", "fused"), ("environment", "fused"), ("part", "reward")}  # quick to compile: for all numbers of arms
COLUMNS = {
    "env": "{env}",
    "group": "{group}",
    "case": "{case}",
    "arms": "{arms:,}",
    "steps/s": "{steps_per_s:,.0f}",  # Runge-Kutta steps of the physics, else environment steps
    "spread": "{spread:.0%}",
    "compile [s]": "{compile_s:.1f}",
    "bytes/arm": "{bytes_per_arm:,.0f}",
}


def run(
    envs: Sequence[str],
    sizes: Sequence[int],
    peer_sizes: Sequence[int],
    save: Callable[[list[Row]], None],
    names: Sequence[str] = NAMES,
) -> list[Row]:
    """A row for each measurement of the named cases, saved one by one; a case that fails is a row with the reason."""
    jobs = [
        (name, group, case, arms)
        for name in envs
        for group, cases in CASES.items()
        for case in cases
        if case in names
        for arms in sorted({*peer_sizes, *(sizes if (group, case) in OWN else ())})
    ]
    environments = {name: mimic.make(name, physics="fused") for name in envs}
    rows: list[Row] = []
    for name, group, case, arms in track(jobs, "rollout", console=Console(stderr=True), transient=True):
        row: Row = {"env": name, "group": group, "case": case, "arms": arms}
        try:
            timing = CASES[group][case](environments[name], arms)
            steps = arms * STEPS * (environments[name].config.substeps if group == "physics" else 1)
            row |= timing.summary()
            row |= {"steps_per_s": steps / timing.median, "bytes_per_arm": timing.bytes / arms}
        except Exception as error:  # a peer that is not installed or out of memory
            row |= failure(error)
        rows.append(row)
        save(rows)
    return rows


def main() -> None:
    parser = BenchmarkParser("rollout", __doc__)
    parser.add_names("--envs", ENVS)
    parser.add_numbers("--arms", ARMS, "numbers of arms")
    parser.add_numbers("--peer-arms", PEER_ARMS, "numbers of arms of the slower cases")
    parser.add_names("--cases", NAMES)
    options = parser.parse_args()
    results = Results("rollout", options)
    save = lambda rows: results.write(control_steps=STEPS, rows=rows)  # noqa: E731
    rows = run(options.envs, options.arms, options.peer_arms, save, options.cases)
    if not rows:
        parser.error("--arms, --peer-arms: expected a number of arms for the cases of --cases, got none")
    print_table(rows, COLUMNS)


if __name__ == "__main__":
    main()
