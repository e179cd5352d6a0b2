"""How fast arms are simulated, and the environment steps: steps per second, and where the time of a step goes.

    python -m benchmarks.rollout --out FILE [--envs panda7dof ...] [--arms 64 512 ...] [--peer-arms 512 ...]
                                [--cases fused MJX-Warp ...]

Every program makes control steps of 0.1 s under random torques: 10 Runge-Kutta steps of 10 ms, the environment's own.
Physics is that of the environments, `fused` and `mjx`, against a loop that carries `mjx.Data` as is usual, MJX-Warp
where it is installed, and C MuJoCo's threaded rollout on the processor. Environment steps have the reward, the
observation and new episodes besides; the stock one carries and resets `mjx.Data`, as brax environments usually do, with
our reward. Times are of the second call on: median and spread (quartiles) of repeats; compilation is apart.
"""

import argparse
import os
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt  # noqa: E402
import mujoco  # noqa: E402
import mujoco.rollout  # noqa: E402
import numpy as np  # noqa: E402
from brax.envs.base import Wrapper  # noqa: E402
from mujoco import mjx  # noqa: E402
from rich.console import Console  # noqa: E402
from rich.progress import track  # noqa: E402
from rich.table import Table  # noqa: E402

import mimic  # noqa: E402
from benchmarks import stock  # noqa: E402
from benchmarks.record import write_results  # noqa: E402
from benchmarks.timing import Timing, time_call, time_program  # noqa: E402
from mimic.envs.imitation import ImitationEnv  # noqa: E402
from mimic.envs.physics import Load, make_advance  # noqa: E402
from mimic.envs.wrappers import wrap_for_training  # noqa: E402

ENVS = ("panda7dof", "panda4dof", "panda3dof")
ARMS = (64, 512, 4096, 8192, 32768, 65536, 131072)
PEER_ARMS = (512, 8192, 65536)  # of what is slow to compile and to run
STEPS = 10  # control steps in a program

Case = Callable[[ImitationEnv, int], Timing]


def random_motion(env: ImitationEnv, arms: int) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Joint states of arms, and a torque for each control step."""
    key_qpos, key_torque = jax.random.split(jax.random.PRNGKey(0))
    qpos = env.learner.home + jax.random.uniform(key_qpos, (arms, env.action_size), minval=-1.0, maxval=1.0)
    actions = jax.random.uniform(key_torque, (STEPS, arms, env.action_size), minval=-1.0, maxval=1.0)
    return qpos, jnp.zeros_like(qpos), 0.1 * actions * env.torque_scale


def own_physics(physics: str) -> Case:
    """The environments' physics, which carries joint states alone."""

    def case(env: ImitationEnv, arms: int) -> Timing:
        substeps = env.config.substeps
        advance = make_advance(env.arm.model, env.config.control_dt / substeps, substeps, physics)

        def step(state: Any, torque: jax.Array) -> Any:
            qpos, qvel = state
            return jax.vmap(lambda q, v, held: advance(q, v, held, Load()))(qpos, qvel, torque), None

        return time_program(lambda q, v, torques: jax.lax.scan(step, (q, v), torques)[0], *random_motion(env, arms))

    return case


def carried_data(implementation: str) -> Case:
    """`mjx.step`, from one `mjx.Data` to the next."""

    def case(env: ImitationEnv, arms: int) -> Timing:
        model = env.arm.model.__copy__()
        model.opt.timestep = env.config.control_dt / env.config.substeps
        mjx_model = mjx.put_model(model, impl=implementation)
        blank = mjx.make_data(model, impl=implementation)
        qpos, qvel, torques = random_motion(env, arms)
        data = jax.vmap(lambda q, v: blank.replace(qpos=q, qvel=v))(qpos, qvel)

        def step(data: Any, torque: jax.Array) -> Any:
            data = data.replace(qfrc_applied=torque)
            one = jax.vmap(lambda d: mjx.step(mjx_model, d))
            return jax.lax.fori_loop(0, env.config.substeps, lambda _, d: one(d), data), None

        return time_program(lambda d, t: jax.lax.scan(step, d, t)[0], data, torques)

    return case


def mujoco_threads(env: ImitationEnv, arms: int) -> Timing:
    """C MuJoCo on all cores of the processor."""
    model = env.arm.model.__copy__()
    model.opt.timestep = env.config.control_dt / env.config.substeps
    threads = [mujoco.MjData(model) for _ in range(os.cpu_count() or 1)]
    qpos, qvel, torques = (np.asarray(x, float) for x in random_motion(env, arms))
    full = mujoco.mjtState.mjSTATE_FULLPHYSICS
    start = np.zeros((arms, mujoco.mj_stateSize(model, full)))
    start[:, 1 : 1 + qpos.shape[1]], start[:, 1 + qpos.shape[1] : 1 + 2 * qpos.shape[1]] = qpos, qvel  # time is first
    control = np.repeat(torques.swapaxes(0, 1), env.config.substeps, axis=1)
    applied = int(mujoco.mjtState.mjSTATE_QFRC_APPLIED)
    with mujoco.rollout.Rollout(nthread=len(threads)) as pool:
        return time_call(lambda: pool.rollout(model, threads, start, control, control_spec=applied))


def environment(physics: str) -> Case:
    """All of an environment step as PPO makes it, new episodes included."""

    def case(env: ImitationEnv, arms: int) -> Timing:
        wrapped = wrap_for_training(_with_physics(env, physics), env.config.horizon + 1)
        return _steps(wrapped, env.action_size, arms)

    return case


def stock_environment(env: ImitationEnv, arms: int) -> Timing:
    """The same task as brax environments usually have it: `mjx.Data` is carried, and reset to a stored first one."""
    return _steps(stock.wrap(stock.StockEnv(env), env.config.horizon + 1), env.action_size, arms)


def _steps(wrapped: Wrapper, action_size: int, arms: int) -> Timing:
    state = jax.jit(wrapped.reset)(jax.random.split(jax.random.PRNGKey(0), arms))
    actions = jax.random.uniform(jax.random.PRNGKey(1), (STEPS, arms, action_size), minval=-1.0, maxval=1.0)

    def step(state: Any, action: jax.Array) -> Any:
        state = wrapped.step(state, action)
        return state, (state.reward, jnp.sum(state.obs, axis=-1))  # all of it is asked for, little is kept

    return time_program(lambda s, a: jax.lax.scan(step, s, a), state, actions)


def part(what: str) -> Case:
    """One part of the environment step by itself."""

    def case(env: ImitationEnv, arms: int) -> Timing:
        qpos, qvel, torques = random_motion(env, arms)
        keys = jax.random.split(jax.random.PRNGKey(0), arms)
        started = jax.jit(jax.vmap(env.start))(keys)

        def reward(state: Any) -> jax.Array:
            return jax.vmap(env.distance)(state.qpos, state.qvel, state.demonstration, state.step)

        def observation(state: Any) -> jax.Array:
            return jnp.sum(jax.vmap(env.observe)(state), axis=-1)

        def new_episode(state: Any) -> jax.Array:
            fresh = jax.vmap(env.start)(state.key)
            return jnp.sum(fresh.qpos, axis=-1) + fresh.demonstration + fresh.key[:, 0]

        program = {"reward": reward, "observation": observation, "new episode": new_episode}[what]

        def step(state: Any, torque: jax.Array) -> Any:
            state = state.replace(qpos=state.qpos + 1e-3 * torque, step=state.step + 1)
            return state, program(state)

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
    "part": {name: part(name) for name in ("reward", "observation", "new episode")},
}
NAMES = tuple(dict.fromkeys(case for cases in CASES.values() for case in cases))
OWN = {("physics", "fused"), ("environment", "fused"), ("part", "reward")}  # quick to compile: with all numbers of arms


def _with_physics(env: ImitationEnv, physics: str) -> ImitationEnv:
    return mimic.make(env.config.name, physics=physics) if physics != env.config.physics else env


def run(
    envs: Sequence[str],
    sizes: Sequence[int],
    peer_sizes: Sequence[int],
    save: Callable[[list[dict[str, Any]]], None],
    names: Sequence[str] = NAMES,
) -> list[dict[str, Any]]:
    """A row for each measurement of the cases so named, saved as they come; what fails is a row that says why."""
    jobs = [
        (name, group, case, arms)
        for name in envs
        for group, cases in CASES.items()
        for case in cases
        if case in names
        for arms in sorted({*peer_sizes, *(sizes if (group, case) in OWN else ())})
    ]
    made = {name: mimic.make(name, physics="fused") for name in envs}
    rows = []
    for name, group, case, arms in track(jobs, "rollout", console=Console(stderr=True), transient=True):
        row: dict[str, Any] = {"env": name, "group": group, "case": case, "arms": arms}
        try:
            timing = CASES[group][case](made[name], arms)
        except Exception as error:  # a peer that is not installed or out of memory: the others go on
            rows.append({**row, "failed": str(error).split("\n")[0][:200]})
            save(rows)
            continue
        substeps = made[name].config.substeps if group == "physics" else 1
        rate = arms * STEPS * substeps / timing.median
        rows.append({**row, **timing.summary(), "steps_per_s": rate, "bytes_per_arm": timing.bytes / arms})
        save(rows)
    return rows


def show(rows: list[dict[str, Any]], console: Console) -> None:
    """One table: physics in Runge-Kutta steps, the rest in environment steps."""
    table = Table("env", "what", "by", "arms", "steps/s", "spread", "compile [s]", "bytes/arm")
    for row in rows:
        head = row["env"], row["group"], row["case"], f"{row['arms']:,}"
        if "failed" in row:
            table.add_row(*head, row["failed"][:60])
            continue
        rate, size = row["steps_per_s"], row["bytes_per_arm"]
        table.add_row(*head, f"{rate:,.0f}", f"{row['spread']:.0%}", f"{row['compile_s']:.1f}", f"{size:,.0f}")
    console.print(table)


def draw(rows: list[dict[str, Any]], out: Path) -> None:
    """Steps per second against the number of arms, of the first environment."""
    first = rows[0]["env"]
    figure, all_axes = plt.subplots(1, 2, figsize=(9.5, 3.8), layout="constrained")
    titles = {"physics": "Runge-Kutta steps/s", "environment": "environment steps/s"}
    for axes, (group, title) in zip(all_axes, titles.items(), strict=True):
        for case in CASES[group]:
            found = [r for r in rows if (r["env"], r["group"], r["case"]) == (first, group, case) and "failed" not in r]
            if found:
                axes.loglog([r["arms"] for r in found], [r["steps_per_s"] for r in found], "o-", ms=3, label=case)
        axes.set(xlabel="arms", title=f"{first}: {title}")
        axes.grid(alpha=0.3, which="both")
        if axes.lines:
            axes.legend(fontsize="small")
    figure.savefig(out, dpi=150)
    plt.close(figure)


def main() -> None:
    """Measures, shows, writes."""
    summary = (__doc__ or "").split("\n")[0]
    parser = argparse.ArgumentParser(prog="python -m benchmarks.rollout", description=summary)
    parser.add_argument("--out", type=Path, metavar="FILE", help="file of results; the figure goes beside it")
    parser.add_argument("--envs", nargs="+", choices=ENVS, default=list(ENVS), metavar="NAME", help=", ".join(ENVS))
    parser.add_argument("--arms", nargs="+", type=int, default=list(ARMS), metavar="N")
    parser.add_argument("--peer-arms", nargs="*", type=int, default=list(PEER_ARMS), metavar="N", help="of the others")
    parser.add_argument("--cases", nargs="+", choices=NAMES, default=NAMES, metavar="CASE", help=", ".join(NAMES))
    parser.add_argument("--commit", help="what the results are of, where this is no git checkout")
    options = parser.parse_args()

    def save(rows: list[dict[str, Any]]) -> None:
        if options.out:
            write_results(options.out, "rollout", options.commit, control_steps=STEPS, rows=rows)

    rows = run(options.envs, options.arms, options.peer_arms, save, options.cases)
    if not rows:
        parser.error("--arms, --peer-arms: expected a number of arms for what --cases names, got none")
    show(rows, Console())
    if options.out:
        draw(rows, options.out.with_suffix(".png"))


if __name__ == "__main__":
    main()
