"""How accurately the learner's motion is simulated, by integrator and step size, and what it costs.

    python -m benchmarks.physics --out FILE [--envs panda7dof ...] [--seeds 100]

The learner starts at home at rest; for 5 s a new random torque, uniform within the environment's torque scale, is held
for each control step. The error is the distance of the tip, the end of the last link, from where C MuJoCo has it with
RK4 in steps of 0.1 ms, in double precision. Candidates are C MuJoCo's integrators in double precision, and the
environments' own physics in single precision. Sequences in which a joint of the reference reaches the speed bound, at
which the environment ends an episode as a runaway, are counted and left out of all figures. A state that is no longer
finite has an infinite error, null in the file.
"""

import argparse
import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from rich.console import Console
from rich.table import Table

import mimic
from benchmarks.record import write_results
from mimic.envs.imitation import ImitationEnv
from mimic.envs.physics import Load, make_advance

ENVS = ("panda7dof", "panda4dof", "panda3dof")
STEPS = 50  # control steps of a sequence
REFERENCE_TIMESTEP = 1e-4  # s
SUBSTEPS, OWN_SUBSTEPS = (1, 2, 5, 10, 20, 50), (5, 10, 20)
EVALUATIONS = {"euler": 1, "implicitfast": 1, "rk4": 4}  # of the forward dynamics, a step
PHYSICS = ("mjx", "fused")
GOAL = 1.0  # mm
FIGURES = {"median": 0.5, "p95": 0.95, "max": 1.0}


class Motion(NamedTuple):
    """Joint states after each control step: each [sequences, steps, joints]."""

    qpos: np.ndarray
    qvel: np.ndarray

    def runaways(self, bound: float) -> np.ndarray:
        """Which sequences the environment would end, at its check after each control step."""
        return ~np.all(np.abs(self.qvel) < bound, axis=(1, 2))


def random_torques(env: ImitationEnv, sequences: int) -> np.ndarray:
    """Sequences of torques [sequences, steps, joints], each from a seed of its own."""
    shape = STEPS, env.action_size
    actions = [np.random.default_rng(seed).uniform(-1, 1, shape) for seed in range(sequences)]
    return np.stack(actions) * np.asarray(env.torque_scale, float)


def mujoco_motion(env: ImitationEnv, torques: np.ndarray, integrator: str, substeps: int) -> Motion:
    """C MuJoCo, in double precision."""
    model = env.arm.model.__copy__()
    model.opt.integrator = getattr(mujoco.mjtIntegrator, f"mjINT_{integrator.upper()}")
    model.opt.timestep = env.config.control_dt / substeps
    model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_AUTORESET)  # what diverges shall be seen to

    def sequence(held: np.ndarray) -> np.ndarray:
        data = mujoco.MjData(model)
        data.qpos[:] = env.learner.home
        states = []
        for torque in held:
            data.qfrc_applied[:] = torque
            mujoco.mj_step(model, data, substeps)
            states.append((data.qpos.copy(), data.qvel.copy()))
        return np.array(states)

    with ThreadPoolExecutor(os.cpu_count()) as pool:
        states = np.stack(list(pool.map(sequence, torques)))
    return Motion(states[:, :, 0], states[:, :, 1])


def own_motion(env: ImitationEnv, torques: np.ndarray, physics: str, substeps: int) -> Motion:
    """The environments' own physics, in single precision."""
    advance = make_advance(env.arm.model, env.config.control_dt / substeps, substeps, physics)

    def step(state: tuple[jax.Array, jax.Array], torque: jax.Array) -> Any:
        state = advance(*state, torque, Load())
        return state, state

    @jax.jit
    @jax.vmap
    def sequence(held: jax.Array) -> Any:
        home = jnp.asarray(env.learner.home, jnp.float32)
        return jax.lax.scan(step, (home, jnp.zeros_like(home)), held)[1]

    return Motion(*(np.asarray(x, float) for x in sequence(jnp.asarray(torques, jnp.float32))))


def tip_program(arm: mimic.Embodiment) -> Callable[[np.ndarray], np.ndarray]:
    """Where the last link ends [m], of poses [sequences, steps, joints], in double precision."""

    def tip(qpos: jax.Array) -> jax.Array:
        frames = mimic.forward_kinematics(arm, qpos)  # that sit in the middle of the links
        return frames.position[-1] + arm.link_lengths[-1] / 2 * frames.rotation[-1, :, 0]

    program = jax.jit(jax.vmap(jax.vmap(tip)))

    def tips(qpos: np.ndarray) -> np.ndarray:
        with jax.enable_x64(True):
            return np.asarray(program(jnp.asarray(qpos)))

    return tips


def figures(errors: np.ndarray) -> dict[str, dict[str, float]]:
    """Of errors [sequences, steps]: at the end of the sequences, and the largest within each."""
    errors = np.where(np.isfinite(errors), errors, np.inf)
    of_sequences = {"end": errors[:, -1], "largest": errors.max(axis=1)}
    return {
        when: {name: float(np.quantile(values, share, method="inverted_cdf")) for name, share in FIGURES.items()}
        for when, values in of_sequences.items()
    }


def run_env(name: str, sequences: int) -> dict[str, Any]:
    """All candidates on one environment."""
    env = mimic.make(name, demonstrations={"count": 1, "held_out": 1})
    bound, tips = env.config.speed_bound, tip_program(env.learner)
    torques = random_torques(env, sequences)
    reference = mujoco_motion(env, torques, "rk4", round(env.config.control_dt / REFERENCE_TIMESTEP))
    kept = ~reference.runaways(bound)
    reference_tips = tips(reference.qpos[kept])
    results = []

    def judge(engine: str, integrator: str, substeps: int, motion: Motion) -> None:
        metres = np.linalg.norm(tips(motion.qpos[kept]) - reference_tips, axis=-1)
        results.append(
            {
                "engine": engine,
                "integrator": integrator,
                "substeps": substeps,
                "evaluations": EVALUATIONS[integrator] * substeps,
                "false_runaways": int(motion.runaways(bound)[kept].sum()),
                "error_mm": figures(1e3 * metres),
            }
        )

    for integrator in EVALUATIONS:
        for substeps in SUBSTEPS:
            judge("mujoco", integrator, substeps, mujoco_motion(env, torques, integrator, substeps))
    differences = []
    for substeps in OWN_SUBSTEPS:
        motions = {physics: own_motion(env, torques, physics, substeps) for physics in PHYSICS}
        for physics, motion in motions.items():
            judge(physics, "rk4", substeps, motion)
        apart = np.abs(motions["fused"].qpos - motions["mjx"].qpos)[kept].max(axis=-1)
        differences.append({"substeps": substeps, "difference_rad": figures(apart)})
    return {
        "env": name,
        "action_scale": env.config.action_scale,
        "torque_scale": np.asarray(env.torque_scale, float).tolist(),
        "speed_bound": bound,
        "sequences": sequences,
        "runaways": int((~kept).sum()),
        "median_peak_speed": float(np.median(np.abs(reference.qvel[kept]).max(axis=(1, 2)))),
        "candidates": results,
        "rk4_substeps_below_1mm": enough(results),
        "fused_against_mjx": differences,
    }


def enough(results: Sequence[dict[str, Any]]) -> dict[str, int | None]:
    """The fewest of the tested RK4 steps of C MuJoCo with which an error at the end is below a millimetre."""
    rk4 = [result for result in results if (result["engine"], result["integrator"]) == ("mujoco", "rk4")]
    return {
        name: next((result["substeps"] for result in rk4 if result["error_mm"]["end"][name] < GOAL), None)
        for name in FIGURES
    }


def finite(content: Any) -> Any:
    """The same with None for what JSON cannot say."""
    if isinstance(content, dict):
        return {key: finite(value) for key, value in content.items()}
    if isinstance(content, list):
        return [finite(value) for value in content]
    return None if content == np.inf else content


def print_tables(results: Sequence[dict[str, Any]]) -> None:
    """One row for each candidate, and one for each comparison of our own two."""
    heads = "env", "engine", "integrator", "substeps", "evaluations", *FIGURES, "largest", "false runaways"
    errors = Table(*heads, title="Error of the tip after 5 s \\[mm], and the largest within all sequences")
    apart = Table("env", "substeps", *FIGURES, "largest", title="Joint angles after 5 s, fused against mjx \\[rad]")
    for result in results:
        for row in result["candidates"]:
            error = row["error_mm"]
            errors.add_row(
                result["env"],
                *(str(row[key]) for key in ("engine", "integrator", "substeps", "evaluations")),
                *(f"{error['end'][name]:.3g}" for name in FIGURES),
                f"{error['largest']['max']:.3g}",
                str(row["false_runaways"]),
            )
        for row in result["fused_against_mjx"]:
            difference = row["difference_rad"]
            numbers = *difference["end"].values(), difference["largest"]["max"]
            apart.add_row(result["env"], str(row["substeps"]), *(f"{number:.1e}" for number in numbers))
    console = Console(width=120)  # also where there is no terminal
    console.print(errors, apart)
    for result in results:
        fewest = result["rk4_substeps_below_1mm"].items()
        counts = ", ".join(f"{name} {count or 'none tested'}" for name, count in fewest)
        console.print(
            f"{result['env']}: {result['runaways']} of {result['sequences']} sequences run away and are left out; "
            f"RK4 steps a control step for less than {GOAL:g} mm: {counts}",
            soft_wrap=True,
        )


def main() -> None:
    """Runs all environments, and writes the file after each."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.physics", description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--out", type=Path, help="file of results; printed only where none is given")
    parser.add_argument("--envs", nargs="+", choices=mimic.environments(), default=ENVS)
    parser.add_argument("--seeds", type=int, default=100, metavar="N", help="random sequences of torques")
    parser.add_argument("--commit", help="what the results are of, where this is no git checkout")
    options = parser.parse_args()
    mujoco.set_mju_user_warning(lambda _: None)  # what diverges is counted here; MuJoCo would also log it to a file
    results = []
    for name in options.envs:
        results.append(run_env(name, options.seeds))
        if options.out:
            write_results(options.out, "physics", options.commit, results=finite(results))
    print_tables(results)


if __name__ == "__main__":
    main()
