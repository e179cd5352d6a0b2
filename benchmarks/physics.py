"""Accuracy of the learner's simulated motion, by integrator and step size, and the number of evaluations it costs.

    python -m benchmarks.physics --out FILE [--envs panda7dof ...] [--seeds 100]

The learner starts at home at rest; for 5 s a new random torque within the environment's torque scale is held for each
control step. The error is the distance of the tip from that of C MuJoCo with RK4 in steps of 0.1 ms. Candidates are C
MuJoCo's integrators in double precision, and the environments' own physics in single precision. Sequences in which the
reference reaches the speed bound are counted and excluded. A state that is not finite has an infinite error, null.
"""

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

import mimic
from benchmarks.common.parser import make_parser
from benchmarks.common.record import Row, collect, print_table
from mimic.envs.imitation import ImitationEnv
from mimic.physics.step import make_advance

ENVS = ("panda7dof", "panda4dof", "panda3dof")
STEPS = 50  # control steps of a sequence
REFERENCE_TIMESTEP = 1e-4  # s
SUBSTEPS, OWN_SUBSTEPS = (1, 2, 5, 10, 20, 50), (5, 10, 20)
EVALUATIONS = {"euler": 1, "rk4": 4}  # of the forward dynamics, in a step
QUANTILES = {"median": 0.5, "p95": 0.95, "max": 1.0}
ERRORS = " ".join(f"error_mm[end][{name}]:.3g" for name in QUANTILES)

Motion = tuple[np.ndarray, np.ndarray]  # qpos and qvel after each control step: [sequences, steps, joints]


def mujoco_motion(env: ImitationEnv, torques: np.ndarray, integrator: str, substeps: int) -> Motion:
    model = env.arm.model.__copy__()
    model.opt.integrator = getattr(mujoco.mjtIntegrator, f"mjINT_{integrator.upper()}")
    model.opt.timestep = env.config.control_dt / substeps
    model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_AUTORESET)  # a divergence must be visible

    def sequence(torques: np.ndarray) -> np.ndarray:
        data = mujoco.MjData(model)
        data.qpos[:] = env.learner.home
        states = []
        for torque in torques:
            data.qfrc_applied[:] = torque
            mujoco.mj_step(model, data, substeps)
            states.append((data.qpos.copy(), data.qvel.copy()))
        return np.array(states)

    with ThreadPoolExecutor(os.cpu_count()) as pool:
        states = np.stack(list(pool.map(sequence, torques)))
    return states[:, :, 0], states[:, :, 1]


def own_motion(env: ImitationEnv, torques: np.ndarray, physics: str, substeps: int) -> Motion:
    """The environments' own physics, in single precision."""
    advance = make_advance(env.arm.model, env.config.control_dt / substeps, substeps, physics)
    home = jnp.asarray(env.learner.home, jnp.float32)

    def step(state: tuple[jax.Array, jax.Array], torque: jax.Array) -> Any:
        state = advance(*state, torque)
        return state, state

    sequence = jax.jit(jax.vmap(lambda torques: jax.lax.scan(step, (home, jnp.zeros_like(home)), torques)[1]))
    qpos, qvel = sequence(jnp.asarray(torques, jnp.float32))
    return np.asarray(qpos, float), np.asarray(qvel, float)


def tip_positions(arm: mimic.Embodiment) -> Callable[[np.ndarray], np.ndarray]:
    """A function to the end of the last link [m] of poses [sequences, steps, joints], in double precision."""

    def tip(qpos: jax.Array) -> jax.Array:
        frames = mimic.forward_kinematics(arm, qpos)  # in the middle of the links
        return frames.position[-1] + arm.link_lengths[-1] / 2 * frames.rotation[-1, :, 0]

    batched_tip = jax.jit(jax.vmap(jax.vmap(tip)))

    def tips(qpos: np.ndarray) -> np.ndarray:
        with jax.enable_x64(True):
            return np.asarray(batched_tip(jnp.asarray(qpos)))

    return tips


def run_env(name: str, sequences: int) -> Row:
    env = mimic.make(name, demonstrations={"count": 1, "held_out": 1})
    bound, scale, tips = env.config.speed_bound, np.asarray(env.torque_scale, float), tip_positions(env.learner)
    actions = [np.random.default_rng(seed).uniform(-1, 1, (STEPS, env.action_size)) for seed in range(sequences)]
    torques = scale * np.stack(actions)

    def runaways(qvel: np.ndarray) -> np.ndarray:
        """Sequences that the environment would end, at its check after each control step."""
        return ~np.all(np.abs(qvel) < bound, axis=(1, 2))

    qpos, qvel = mujoco_motion(env, torques, "rk4", round(env.config.control_dt / REFERENCE_TIMESTEP))
    kept = ~runaways(qvel)
    reference = tips(qpos[kept])

    def candidate(engine: str, integrator: str, substeps: int, motion: Motion) -> Row:
        errors = 1e3 * np.linalg.norm(tips(motion[0][kept]) - reference, axis=-1)  # [sequences, steps]
        errors = np.where(np.isfinite(errors), errors, np.inf)
        end = {name: float(np.quantile(errors[:, -1], q, method="inverted_cdf")) for name, q in QUANTILES.items()}
        costs = {"substeps": substeps, "evaluations": EVALUATIONS[integrator] * substeps}
        false = {"false_runaways": int(runaways(motion[1])[kept].sum())}
        return {"engine": engine, "integrator": integrator, **costs, **false, "error_mm": {"end": end}}

    candidates = [
        candidate("mujoco", integrator, substeps, mujoco_motion(env, torques, integrator, substeps))
        for integrator in EVALUATIONS
        for substeps in SUBSTEPS
    ]
    for substeps in OWN_SUBSTEPS:
        for physics in ("mjx", "fused"):
            candidates.append(candidate(physics, "rk4", substeps, own_motion(env, torques, physics, substeps)))
    counts = {"sequences": sequences, "runaways": int((~kept).sum())}
    peak = float(np.median(np.abs(qvel[kept]).max(axis=(1, 2))))
    scales = {"action_scale": env.config.action_scale, "torque_scale": scale.tolist(), "speed_bound": bound}
    return {"env": name, **scales, **counts, "median_peak_speed": peak, "candidates": candidates}


def main() -> None:
    options = make_parser("physics", __doc__, envs=ENVS, seeds=100).parse_args()
    mujoco.set_mju_user_warning(lambda _: None)  # divergence is counted here; MuJoCo would also log it to a file
    rows = (run_env(name, options.seeds) for name in options.envs)
    for row in collect(options, rows, "results", "env sequences runaways median_peak_speed:.1f"):
        print_table(row["candidates"], f"engine integrator substeps evaluations false_runaways {ERRORS}", row["env"])


if __name__ == "__main__":
    main()
