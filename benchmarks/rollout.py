"""Simulation speed: steps per second of the physics, and of whole environment steps.

    python -m benchmarks.rollout --out FILE [--envs panda7dof ...] [--arms 512 8192 ...] [--cases fused mjx ...]

Every case makes control steps of 0.1 s under random torques. The physics of the environments, `fused` and `mjx`, is
compared with a loop that carries `mjx.Data`, and with C MuJoCo's threaded rollout on the CPU; whole environment steps
with the stock one, which carries and resets `mjx.Data`, as brax environments usually do.
"""

import itertools
import os
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import mujoco.rollout
import numpy as np
from mujoco import mjx

import mimic
from benchmarks.common.parser import make_parser
from benchmarks.common.record import Row, collect, failure
from benchmarks.common.timing import Timing, time_call, time_program
from benchmarks.peers import stock
from mimic.envs.imitation import ImitationEnv
from mimic.envs.wrappers import wrap_for_training
from mimic.physics.step import make_advance

ENVS = ("panda7dof", "panda4dof", "panda3dof")
ARMS = [512, 8192, 65536]
STEPS = 10  # control steps in a call
COLUMNS = "env group case arms:, steps_per_s:,.0f spread:.0% compile_s:.1f bytes_per_arm:,.0f"

Case = Callable[[ImitationEnv, int], Timing]


def random_motion(env: ImitationEnv, arms: int) -> tuple[jax.Array, jax.Array, jax.Array]:
    key_qpos, key_torque = jax.random.split(jax.random.PRNGKey(0))
    qpos = env.learner.home + jax.random.uniform(key_qpos, (arms, env.action_size), minval=-1.0, maxval=1.0)
    actions = jax.random.uniform(key_torque, (STEPS, arms, env.action_size), minval=-1.0, maxval=1.0)
    return qpos, jnp.zeros_like(qpos), 0.1 * actions * env.torque_scale


def time_steps(step: Callable[[Any, Any], Any], state: Any, inputs: jax.Array) -> Timing:
    return time_program(lambda state, inputs: jax.lax.scan(step, state, inputs), state, inputs)


def own_physics(physics: str, env: ImitationEnv, arms: int) -> Timing:
    """The physics of the environments, which carries only joint states."""
    substeps = env.config.substeps
    advance = make_advance(env.arm.model, env.config.control_dt / substeps, substeps, physics)
    qpos, qvel, torques = random_motion(env, arms)
    many: Any = jax.vmap(advance)
    return time_steps(lambda state, torques: (many(*state, torques), None), (qpos, qvel), torques)


def carried_data(env: ImitationEnv, arms: int) -> Timing:
    """`mjx.step`, from one `mjx.Data` to the next."""
    model = stock.model_with_substeps(env)
    mjx_model, blank = (make(model, impl="jax") for make in (mjx.put_model, mjx.make_data))
    qpos, qvel, torques = random_motion(env, arms)
    data = jax.vmap(lambda q, v: blank.replace(qpos=q, qvel=v))(qpos, qvel)
    substep = jax.vmap(lambda d: mjx.step(mjx_model, d))

    def step(data: Any, torques: jax.Array) -> Any:
        data = data.replace(qfrc_applied=torques)
        return jax.lax.fori_loop(0, env.config.substeps, lambda _, d: substep(d), data), None

    return time_steps(step, data, torques)


def mujoco_threads(env: ImitationEnv, arms: int) -> Timing:
    model = stock.model_with_substeps(env)
    threads = [mujoco.MjData(model) for _ in range(os.cpu_count() or 1)]
    qpos, qvel, torques = (np.asarray(x, float) for x in random_motion(env, arms))
    state = np.hstack([np.zeros((arms, 1)), qpos, qvel])  # time is first
    control = np.repeat(torques.swapaxes(0, 1), env.config.substeps, axis=1)
    applied = int(mujoco.mjtState.mjSTATE_QFRC_APPLIED)
    with mujoco.rollout.Rollout(nthread=len(threads)) as pool:
        return time_call(lambda: pool.rollout(model, threads, state, control, control_spec=applied))


def environment(kind: str, env: ImitationEnv, arms: int) -> Timing:
    """A whole environment step with new episodes, by a physics of the environments or "stock"."""
    horizon = env.config.horizon + 1
    if kind == "stock":
        wrapped = stock.wrap(stock.StockEnv(env), horizon)
    else:
        wrapped = wrap_for_training(mimic.make(env.config.name, physics=kind), horizon)
    state = jax.jit(wrapped.reset)(jax.random.split(jax.random.PRNGKey(0), arms))
    actions = jax.random.uniform(jax.random.PRNGKey(1), (STEPS, arms, env.action_size), minval=-1.0, maxval=1.0)

    def step(state: Any, action: jax.Array) -> Any:
        state = wrapped.step(state, action)
        return state, (state.reward, jnp.sum(state.obs, axis=-1))  # uses all of the observation, and stores little

    return time_steps(step, state, actions)


CASES: dict[str, dict[str, Case]] = {
    "physics": {
        "fused": partial(own_physics, "fused"),
        "mjx": partial(own_physics, "mjx"),
        "mjx.Data carried": carried_data,
        "C MuJoCo, all cores": mujoco_threads,
    },
    "environment": {kind: partial(environment, kind) for kind in ("fused", "mjx", "stock")},
}
NAMES = tuple(dict.fromkeys(case for cases in CASES.values() for case in cases))


def run(envs: Sequence[str], sizes: Sequence[int], names: Sequence[str]) -> Iterator[Row]:
    """The measurements of the named cases; a case that fails is a row with the reason."""
    for name in envs:
        env = mimic.make(name, physics="fused")
        cases = [(group, case) for group, named in CASES.items() for case in named if case in names]
        for (group, case), arms in itertools.product(cases, sizes):
            row: Row = {"env": name, "group": group, "case": case, "arms": arms}
            try:
                timing = CASES[group][case](env, arms)
                steps = arms * STEPS * (env.config.substeps if group == "physics" else 1)
                rates = {"steps_per_s": steps / timing.median, "bytes_per_arm": timing.bytes / arms}
                yield {**row, **timing.summary(), **rates}
            except Exception as error:  # out of memory
                yield {**row, **failure(error)}


def main() -> None:
    options = make_parser("rollout", __doc__, envs=ENVS, arms=ARMS, cases=NAMES).parse_args()
    rows = run(options.envs, options.arms, options.cases)
    collect(options, rows, "rows", COLUMNS, control_steps=STEPS)


if __name__ == "__main__":
    main()
