"""Poses of a Panda with 4 joints by several methods from the same poses: quality, and poses per second.

    python -m benchmarks.pose --out FILE [--poses 1000] [--batch 1000] [--mink-poses 100]

Quality is (d - d_best) / (d_random - d_best), where d_best is the minimum distance over all methods and a search from
512 random initial guesses with 60 Newton steps each. `global_share` is the fraction of poses within 0.1 % of d_best.
"paper" is its gradient descent from one initial guess, the angles of the joints that both arms have. mink drives the
learner's links to the full orientations, not only directions, of the expert's links that they overlap most.
"""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import mink
import mujoco
import numpy as np

import mimic
from benchmarks.common.parser import make_parser
from benchmarks.common.record import Row, print_table, write_results
from benchmarks.common.timing import time_call
from mimic.arms.arm import Arm, ArmConfig, build_arm
from mimic.arms.pose_limits import pose_limits
from mimic.metric.config import MetricConfig
from mimic.retargeting.pose import shared_joints

METRIC = MetricConfig()
CHUNK = 500  # poses of the longest search in parallel
NEAR, ROUNDING = 1e-3, 1e-6  # tolerance of the global minimum: relative, and absolute for float32
GRADIENT_STEPS, GRADIENT_STEP = 1000, 0.4  # steps, and each in rad per unit of gradient
MINK_STEPS, MINK_DT = 100, 0.1  # steps of inverse kinematics for a pose, and the time that each integrates over [s]
COLUMNS = "method quality:.2% global_share:.2% distance:.4f poses_per_second:,.0f first_call_s:.1f"

Solver = Callable[[np.ndarray], np.ndarray]  # expert's poses -> learner's poses


def imitate(expert: Arm, learner: Arm, **options: Any) -> Solver:
    pair = expert.embodiment, learner.embodiment
    metric = METRIC.build(*pair).arguments
    return jax.jit(lambda qpos: mimic.imitate_pose(*pair, qpos, **metric, **options).qpos)


def gradient_descent(expert: Arm, learner: Arm) -> Solver:
    pair = expert.embodiment, learner.embodiment
    metric, (lower, upper) = METRIC.build(*pair), pose_limits(learner.embodiment, np.float32)

    def solve(qpos: jax.Array) -> jax.Array:
        states = mimic.link_states(pair[0], qpos)
        gradient = jax.grad(lambda pose: metric(states, mimic.link_states(pair[1], pose)))

        def descend(_: int, pose: jax.Array) -> jax.Array:
            return jnp.clip(pose - GRADIENT_STEP * gradient(pose), lower, upper)

        return jax.lax.fori_loop(0, GRADIENT_STEPS, descend, shared_joints(*pair, qpos))

    return jax.jit(jax.vmap(solve))


def with_mink(expert: Arm, learner: Arm) -> Solver:
    """mink: orientation tasks on corresponding links, one pose after the other."""
    model, arm = learner.model, learner.embodiment
    partner = np.asarray(METRIC.make_correspondence(expert.embodiment, arm)).argmax(axis=0)
    zero = mujoco.MjData(model)
    mujoco.mj_forward(model, zero)
    frames = jax.jit(jax.vmap(lambda q: mimic.forward_kinematics(expert.embodiment, q).rotation))
    bodies = [int(model.jnt_bodyid[joint]) for joint in arm.link_joint]
    # T_link_body of each link's body, in the zero pose.
    offsets = [arm.link_rotation[i].T @ zero.xmat[body].reshape(3, 3) for i, body in enumerate(bodies)]
    tasks = [mink.FrameTask(body, "body", position_cost=0.0, orientation_cost=1.0) for body in bodies]

    def solve(qpos: np.ndarray) -> np.ndarray:
        poses = []
        for rotations in np.asarray(frames(jnp.asarray(qpos)), float):
            configuration = mink.Configuration(model, np.zeros(model.nq))
            for task, offset, expert_link in zip(tasks, offsets, partner, strict=True):
                left, _, right = np.linalg.svd(rotations[expert_link] @ offset)  # orthonormal, as mink demands
                task.set_target(mink.SE3.from_rotation(mink.SO3.from_matrix(left @ right)))
            for _ in range(MINK_STEPS):
                velocity = mink.solve_ik(configuration, tasks, MINK_DT, solver="daqp", damping=1e-3, limits=[])
                configuration.integrate_inplace(velocity, MINK_DT)
            poses.append(configuration.q.copy())
        return np.asarray(poses, np.float32)

    return solve


def measure(poses: int, batch: int, mink_poses: int) -> Row:
    expert, learner = build_arm(ArmConfig()), build_arm(ArmConfig(locked=[3, 6, 7]))
    metric = METRIC.build(expert.embodiment, learner.embodiment)
    joints = expert.embodiment.num_joints, learner.embodiment.num_joints

    @jax.jit
    @jax.vmap
    def distances(qpos: jax.Array, learner_qpos: jax.Array) -> jax.Array:
        return metric(mimic.link_states(expert.embodiment, qpos), mimic.link_states(learner.embodiment, learner_qpos))

    rng, shapes = np.random.default_rng(0), [(poses, joints[0]), (poses, joints[1]), (batch, joints[0])]
    qpos, chance, many = (rng.uniform(-np.pi, np.pi, shape).astype(np.float32) for shape in shapes)
    solvers = {
        "newton": imitate(expert, learner),
        "paper": gradient_descent(expert, learner),
        "mink": with_mink(expert, learner),
    }
    methods, left = {}, {}
    for method, solver in solvers.items():
        judged, timed, repeats = (qpos[:mink_poses], qpos[:mink_poses], 1) if method == "mink" else (qpos, many, 5)
        timing = time_call(lambda solver=solver, timed=timed: solver(timed), repeats=repeats)
        left[method] = np.asarray(distances(judged, solver(judged)))
        methods[method] = {"batch": len(timed), "poses_per_second": len(timed) / timing.median}
        methods[method] |= {"spread_s": [timing.low, timing.high], "first_call_s": timing.first}
    search = imitate(expert, learner, key=jax.random.key(1), starts=512, iterations=60)
    best = np.array(distances(qpos, jax.lax.map(search, qpos, batch_size=CHUNK)))
    for values in left.values():
        best[: len(values)] = np.minimum(best[: len(values)], values)
    random = float(np.mean(np.asarray(distances(qpos, chance))))
    for method, values in left.items():
        minimum, distance = best[: len(values)], float(values.mean())
        quality = float((distance - minimum.mean()) / (random - minimum.mean()))
        is_global = values <= minimum * (1 + NEAR) + ROUNDING
        methods[method] |= {"poses": len(values), "distance": distance, "quality": quality}
        methods[method]["global_share"] = float(np.mean(is_global))
    return {"pair": "panda 7->4", "best_distance": float(best.mean()), "random_distance": random, "methods": methods}


def main() -> None:
    options = make_parser("pose", __doc__, poses=1000, batch=1000, mink_poses=100).parse_args()
    row = measure(options.poses, options.batch, options.mink_poses)
    write_results(options, results=[row])
    print_table(({"method": name, **values} for name, values in row["methods"].items()), COLUMNS, row["pair"])


if __name__ == "__main__":
    main()
