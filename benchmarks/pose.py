"""Pose imitation against what one would do instead, on the same poses: quality, and poses per second.

    python -m benchmarks.pose --out FILE [--poses 1000] [--batch 1000] [--mink-poses 100]

Quality is (d - d_best) / (d_random - d_best), where d_best is the least distance that any method found for a pose, and
a search from 512 random starts with 60 Newton steps each: 0 is the best known pose, 1 a random one. "Global" is the
share of poses within 0.1 % of d_best. Poses of the expert are uniform in [-pi, pi]; the metric is the default one,
`MetricConfig`. "One start" is the paper's way, from the angles that both arms share. mink drives the learner's links to
the full orientations of the expert's links that they overlap most, which asks for more than directions.
"""

import argparse
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import mink
import mujoco
import numpy as np
from rich.console import Console
from rich.table import Table

import mimic
from benchmarks.record import write_results
from mimic.arms.arm import Arm, ArmConfig, build_arm
from mimic.metric.config import MetricConfig

METRIC = MetricConfig()
REPEATS = 5
EXHAUSTIVE = {"starts": 512, "iterations": 60}
CHUNK = 500  # poses that are searched exhaustively at once
NEAR, ROUNDING = 1e-3, 1e-6  # what counts as the global minimum: relative, and absolute for float32
MINK_STEPS, MINK_DT = 100, 0.1  # steps of inverse kinematics for a pose, and the time that each integrates over [s]

_Solver = Callable[[np.ndarray], np.ndarray]  # expert's poses -> learner's poses


def planar(links: int) -> ArmConfig:
    """A planar arm of equal links, 1 m long."""
    return ArmConfig(model="planar", link_lengths=[1 / links] * links)


PAIRS = {
    "planar 7->4": (planar(7), planar(4)),
    "planar 4->7": (planar(4), planar(7)),
    "panda 7->7": (ArmConfig(), ArmConfig()),
    "panda 7->4": (ArmConfig(), ArmConfig(locked=[3, 6, 7])),
    "panda 7->3": (ArmConfig(), ArmConfig(locked=[2, 3, 6, 7])),
}


def optimiser(expert: Arm, learner: Arm, method: Any, **options: Any) -> _Solver:
    """`imitate_pose`, compiled once."""
    correspondence = METRIC.make_correspondence(expert.embodiment, learner.embodiment)

    @jax.jit
    def solve(qpos: jax.Array) -> jax.Array:
        pair = expert.embodiment, learner.embodiment
        return mimic.imitate_pose(*pair, qpos, correspondence, METRIC.make_weights(), method=method, **options).qpos

    return lambda qpos: np.asarray(solve(jnp.asarray(qpos)))


def with_mink(expert: Arm, learner: Arm) -> _Solver:
    """mink: orientation tasks on corresponding links, one pose after the other."""
    model, arm = learner.model, learner.embodiment
    partner = np.asarray(METRIC.make_correspondence(expert.embodiment, arm)).argmax(axis=0)
    zero = mujoco.MjData(model)
    mujoco.mj_forward(model, zero)
    frames = jax.jit(jax.vmap(lambda q: mimic.forward_kinematics(expert.embodiment, q).rotation))
    bodies = [int(model.jnt_bodyid[joint]) for joint in arm.link_joint]
    # A link's frame in the frame of its body, from the zero pose.
    offsets = [arm.link_rotation[i].T @ zero.xmat[body].reshape(3, 3) for i, body in enumerate(bodies)]
    tasks = [mink.FrameTask(body, "body", position_cost=0.0, orientation_cost=1.0) for body in bodies]

    def solve(qpos: np.ndarray) -> np.ndarray:
        found = []
        for rotations in np.asarray(frames(jnp.asarray(qpos)), float):
            configuration = mink.Configuration(model, np.zeros(model.nq))
            for task, body_offset, expert_link in zip(tasks, offsets, partner, strict=True):
                target = mink.SO3.from_matrix(_orthonormal(rotations[expert_link] @ body_offset))
                task.set_target(mink.SE3.from_rotation(target))
            for _ in range(MINK_STEPS):
                velocity = mink.solve_ik(configuration, tasks, MINK_DT, solver="daqp", damping=1e-3, limits=[])
                configuration.integrate_inplace(velocity, MINK_DT)
            found.append(configuration.q.copy())
        return np.asarray(found, np.float32)

    return solve


def _orthonormal(matrix: np.ndarray) -> np.ndarray:
    left, _, right = np.linalg.svd(matrix)
    return left @ right


def exhaustive(expert: Arm, learner: Arm) -> _Solver:
    """`imitate_pose` from very many starts, other ones than its own."""
    solve = optimiser(expert, learner, "newton", key=jax.random.key(1), **EXHAUSTIVE)

    def in_chunks(qpos: np.ndarray) -> np.ndarray:
        chunk = min(CHUNK, len(qpos))
        padded = np.concatenate([qpos, np.repeat(qpos[-1:], -len(qpos) % chunk, axis=0)])
        return np.concatenate([solve(part) for part in padded.reshape(-1, chunk, qpos.shape[1])])[: len(qpos)]

    return in_chunks


def measure(solver: _Solver, qpos: np.ndarray, repeats: int) -> dict[str, Any]:
    """The time of a batch once it is compiled."""
    began = time.perf_counter()
    solver(qpos)
    first = time.perf_counter() - began
    seconds = []
    for _ in range(repeats):
        began = time.perf_counter()
        solver(qpos)
        seconds.append(time.perf_counter() - began)
    return {
        "batch": len(qpos),
        "poses_per_second": len(qpos) / float(np.median(seconds)),
        "spread_s": [min(seconds), max(seconds)],
        "first_call_s": first,
    }


def run_pair(name: str, poses: int, batch: int, mink_poses: int) -> dict[str, Any]:
    """All methods on one pair of arms."""
    expert, learner = map(build_arm, PAIRS[name])
    correspondence = METRIC.make_correspondence(expert.embodiment, learner.embodiment)

    @jax.jit
    @jax.vmap
    def distance(qpos: jax.Array, learner_qpos: jax.Array) -> jax.Array:
        states = mimic.link_states(expert.embodiment, qpos), mimic.link_states(learner.embodiment, learner_qpos)
        return mimic.embodiment_distance(*states, correspondence, METRIC.make_weights())

    rng = np.random.default_rng(0)

    def random_poses(arm: Arm, count: int) -> np.ndarray:
        return rng.uniform(-np.pi, np.pi, (count, arm.embodiment.num_joints)).astype(np.float32)

    qpos, chance, many = random_poses(expert, poses), random_poses(learner, poses), random_poses(expert, batch)
    plain = "gradient_descent"
    solvers: dict[str, tuple[_Solver, np.ndarray, np.ndarray, int]] = {
        "newton": (optimiser(expert, learner, "newton"), qpos, many, REPEATS),
        "gradient_descent": (optimiser(expert, learner, plain), qpos, many, REPEATS),
        "gradient_descent, one start": (optimiser(expert, learner, plain, starts=0), qpos, many, REPEATS),
        "mink": (with_mink(expert, learner), qpos[:mink_poses], qpos[:mink_poses], 1),
    }
    figures, distances = {}, {}
    for method, (solver, judged, timed, repeats) in solvers.items():
        figures[method] = measure(solver, timed, repeats)
        distances[method] = np.asarray(distance(judged, solver(judged)))
    best = np.array(distance(qpos, exhaustive(expert, learner)(qpos)))
    for values in distances.values():
        best[: len(values)] = np.minimum(best[: len(values)], values)
    random = float(np.mean(np.asarray(distance(qpos, chance))))
    for method, values in distances.items():
        least = best[: len(values)]
        figures[method] |= {
            "poses": len(values),
            "distance": float(values.mean()),
            "quality": float((values.mean() - least.mean()) / (random - least.mean())),
            "global_share": float(np.mean(values <= least * (1 + NEAR) + ROUNDING)),
        }
    return {"pair": name, "best_distance": float(best.mean()), "random_distance": random, "methods": figures}


def main() -> None:
    """Runs all pairs, and writes the file after each."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.pose", description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--out", type=Path, help="file of results; printed only where none is given")
    parser.add_argument("--pair", choices=PAIRS, action="append", help="only this one (may be repeated)")
    parser.add_argument("--poses", type=int, default=1000, help="that quality is judged on")
    parser.add_argument("--batch", type=int, default=1000, help="poses at once where speed is measured")
    parser.add_argument("--mink-poses", type=int, default=100, help="mink solves one pose after the other")
    parser.add_argument("--commit", help="what the results are of, where this is no git checkout")
    options = parser.parse_args()
    table = Table("pair", "method", "quality", "global", "distance", "poses/s", "first call [s]")
    results = []
    for name in options.pair or PAIRS:
        results.append(run_pair(name, options.poses, options.batch, min(options.mink_poses, options.poses)))
        for method, figures in results[-1]["methods"].items():
            table.add_row(
                name,
                method,
                f"{figures['quality']:.2%}",
                f"{figures['global_share']:.2%}",
                f"{figures['distance']:.4f}",
                f"{figures['poses_per_second']:,.0f}",
                f"{figures['first_call_s']:.1f}",
            )
        if options.out:
            write_results(options.out, "pose", options.commit, results=results)
    Console(width=120).print(table)  # also where there is no terminal


if __name__ == "__main__":
    main()
