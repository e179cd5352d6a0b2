"""Exact hands: a Panda's hand on other arms, on random poses and on recorded demonstrations.

    python -m benchmarks.exact_hands ur5e=FILE iiwa14=FILE ... [--poses 1000] [--demonstrations FOLDER] [--out FILE]
    python -m benchmarks.exact_hands ur5e=FILE --throughput 65536     # poses/s of one batch, for a GPU

NAME=FILE is an arm and its MJCF or URDF file, with @TIP after it for a file with several arms; NAME is one of SPEEDS.
fr3= without a file is the Panda with other ranges. ssik and mink must be installed; PyRoki is compared where it is.

Random poses: within the Panda's joint ranges, with both bases at one place. `solved` is the fraction of the poses that
ssik (closed form) solves which `imitate_pose` solves too; `unsolved_by_ssik` counts what it solves beyond. Hands are
checked in double precision. Demonstrations: recordings of robosuite, with a base from `find_base`. ssik takes the
solution nearest to the last one, and the first one to the home pose. From there mink tracks the hand in ten steps a
frame, and PyRoki by least squares from the last pose, with a small cost of leaving it. The elbow is compared in chain
lengths in the axes of the expert's base, and the plane of shoulder, elbow and wrist by its normal.
"""

import argparse
import dataclasses
import io
import time
from collections.abc import Callable, Iterator
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import h5py
import jax
import mujoco
import numpy as np

import mimic
from benchmarks.common.parser import make_parser
from benchmarks.common.record import Row, print_table, write_results
from mimic.arms.arm import ArmConfig, build_arm
from mimic.arms.embodiment import Embodiment
from mimic.arms.model_tree import quaternion
from mimic.arms.pose_limits import pose_limits
from mimic.metric.config import MetricConfig
from mimic.retargeting.hand_target import placement

RANDOM = (
    "learner joints ssik_solves:.1% solved:.2% unsolved_by_ssik position_error_um:.2f rotation_error_mdeg:.2f "
    "distance:.3f"
)
MOTIONS = (
    "learner demonstration method exact:.1% position_mm:.3f rotation_deg:.3f fastest:.2f elbow:.3f plane_deg:.1f "
    "fps:.0f"
)
# rad/s, from the manufacturers' data sheets; MJCF files have none.
SPEEDS: dict[str, list[float]] = {
    "panda": [2.175] * 4 + [2.61] * 3,
    "ur5e": [3.14] * 6,
    "iiwa14": [1.48, 1.48, 1.74, 1.30, 2.26, 2.35, 2.35],
    "gen3": [1.39] * 4 + [1.22] * 3,
    "jaco": [0.63] * 3 + [0.84] * 4,
    "xarm7": [3.14] * 7,
    "fr3": [2.62] * 4 + [5.26, 4.18, 5.26],
}
# FR3: the Panda's kinematics with other ranges [rad] (data sheet).
FR3_RANGES = [[-2.7437, 2.7437], [-1.7837, 1.7837], [-2.9007, 2.9007], [-3.0421, -0.1518], [-2.8065, 2.8065],
              [0.5445, 4.5169], [-3.0159, 3.0159]]  # fmt: skip
TASKS = ("lift", "door", "nut-assembly", "pick-place", "stack", "wipe")
_MINK_STEPS = 10


def arm_of(argument: str) -> tuple[str, Embodiment]:
    """Name and embodiment of an argument NAME=FILE@TIP."""
    name, _, file = argument.partition("=")
    if argument == "fr3=":
        return "fr3", dataclasses.replace(mimic.panda(limits="hardware"), joint_range=np.array(FR3_RANGES), name="fr3")
    model, _, tip = file.partition("@")
    return name, build_arm(ArmConfig(model=model, tip=tip or None), "hardware").embodiment


def joint_motions(arm: Embodiment, qpos: np.ndarray) -> Iterator[np.ndarray]:
    """Motion [..., 4, 4] of each joint's child body from the zero pose, in double precision (Rodrigues)."""
    motion = np.eye(4)
    for axis, anchor, angle in zip(arm.joint_axis, arm.joint_anchor, np.moveaxis(qpos, -1, 0), strict=True):
        skew, angle = np.cross(np.eye(3), axis), angle[..., None, None]
        rotation = np.eye(3) + np.sin(angle) * skew + (1 - np.cos(angle)) * skew @ skew
        step = np.zeros((*rotation.shape[:-2], 4, 4)) + np.eye(4)
        step[..., :3, :3], step[..., :3, 3] = rotation, anchor - rotation @ anchor
        motion = motion @ step
        yield motion


def hand_matrices(arm: Embodiment, qpos: np.ndarray) -> np.ndarray:
    """Hand poses [..., 4, 4] in the base frame."""
    *_, last = joint_motions(arm, qpos)
    return last @ homogeneous(arm.hand_rotation[0], arm.hand_position[0])


def homogeneous(rotation: np.ndarray, position: np.ndarray) -> np.ndarray:
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = rotation, position
    return pose


def errors(arm: Embodiment, qpos: np.ndarray, targets: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Distance [m] and angle [rad] of the hands from targets [..., 4, 4]."""
    apart = hand_matrices(arm, qpos) - targets
    chord = np.linalg.norm(apart[..., :3, :3], axis=(-2, -1)) / np.sqrt(8)
    return np.linalg.norm(apart[..., :3, 3], axis=-1), 2 * np.arcsin(np.minimum(chord, 1))


def ssik_solver(arm: Embodiment) -> tuple[Any, np.ndarray]:
    """ssik's arm, and the rotation from its hand to ours."""
    import ssik

    points = np.concatenate([np.zeros((1, 3)), arm.joint_anchor, arm.hand_position])
    solver = ssik.Manipulator.from_axes(arm.joint_axis, np.diff(points, axis=0), limits=arm.joint_range)
    return solver, homogeneous(arm.hand_rotation[0].T, np.zeros(3))


def closed_form(arm: Embodiment) -> Callable[..., np.ndarray | None]:
    """ssik: from a hand pose [4, 4] and a seed to the nearest solution, None where there is none."""
    solver, back = ssik_solver(arm)

    def solve(target: np.ndarray, seed: np.ndarray | None = None) -> np.ndarray | None:
        solutions = solver.solve(target @ back, q_seed=seed, max_solutions=1, enumerate_windings=seed is not None)
        return np.asarray(solutions[0].q) if solutions else None

    return solve


def random_row(expert: Embodiment, name: str, learner: Embodiment, count: int) -> Row:
    lower, upper = expert.joint_range.T
    qpos = np.random.default_rng(0).uniform(lower, upper, (count, expert.num_joints)).astype(np.float32)
    targets, metric = hand_matrices(expert, qpos.astype(float)), MetricConfig().build(expert, learner)
    solve, began = closed_form(learner), time.perf_counter()
    by_ssik = np.array([solve(target) is not None for target in targets])
    ssik_ms = 1e3 * (time.perf_counter() - began) / count
    solution = jax.device_get(mimic.imitate_pose(expert, learner, qpos, **metric.arguments, hand="exact"))
    exact = solution.hand.exact
    position, rotation = (x[exact].max() for x in errors(learner, solution.qpos.astype(float), targets))
    lower, upper = learner.joint_range.T
    assert np.all((solution.qpos[exact] > lower - 1e-6) & (solution.qpos[exact] < upper + 1e-6))
    return as_numbers(
        {
            "learner": name,
            "joints": learner.num_joints,
            "poses": count,
            "ssik_solves": by_ssik.mean(),
            "ssik_ms": ssik_ms,
            "solved": exact[by_ssik].mean(),
            "unsolved_by_ssik": int(np.sum(exact & ~by_ssik)),
            "position_error_um": 1e6 * position,
            "rotation_error_mdeg": 1e3 * np.degrees(rotation),
            "distance": solution.distance[exact].mean(),
        }
    )


def throughput_row(expert: Embodiment, name: str, learner: Embodiment, count: int, runs: int = 5) -> Row:
    """Poses a second of one batch, after compilation; the median over runs."""
    metric = MetricConfig().build(expert, learner).arguments
    lower, upper = expert.joint_range.T
    batches = np.random.default_rng(0).uniform(lower, upper, (runs + 1, count, expert.num_joints))
    times = []
    for batch in jax.numpy.asarray(batches, np.float32):
        began = time.perf_counter()
        solution = jax.block_until_ready(mimic.imitate_pose(expert, learner, batch, **metric, hand="exact"))
        times.append(time.perf_counter() - began)
    rates = count / np.array(times[1:])
    row = {"learner": name, "poses": count, "exact": float(solution.hand.exact.mean()), "first_s": times[0]}
    return as_numbers({**row, "poses_per_s": np.median(rates), "slowest": rates.min(), "fastest": rates.max()})


def as_numbers(row: Row) -> Row:
    """The row with Python's numbers in place of NumPy's."""
    return {key: value.item() if isinstance(value, np.generic) else value for key, value in row.items()}


def followed_by_ssik(arm: Embodiment, targets: np.ndarray, start: np.ndarray) -> np.ndarray:
    """The nearest closed-form solution to the last one at each time, which holds where there is none."""
    solve, path = closed_form(arm), [start]
    for target in targets:
        solution = solve(target, path[-1])
        path.append(path[-1] if solution is None else solution)
    return np.stack(path[1:])


def mink_model(arm: Embodiment) -> mujoco.MjModel:
    """A model of an arm's joints and ranges, with a site `hand`."""
    spec = mujoco.MjSpec()
    spec.compiler.autolimits, spec.compiler.degree = False, False
    body, origin = spec.worldbody, np.zeros(3)
    for name, axis, anchor, low, high in zip(
        arm.joint_names, arm.joint_axis, arm.joint_anchor, *pose_limits(arm, float), strict=True
    ):
        body = body.add_body(pos=anchor - origin, mass=1.0, inertia=np.ones(3), explicitinertial=True)
        limited, origin = bool(np.isfinite(low)), anchor
        body.add_joint(name=name, axis=axis, range=[low, high] if limited else [0.0, 0.0], limited=limited)
    body.add_site(name="hand", pos=arm.hand_position[0] - origin, quat=quaternion(arm.hand_rotation[0]))
    return spec.compile()


def followed_by_mink(arm: Embodiment, targets: np.ndarray, start: np.ndarray) -> np.ndarray:
    """Ten steps of mink from the last pose at each time."""
    import mink

    model = mink_model(arm)
    configuration, limits = mink.Configuration(model, start.astype(float)), [mink.ConfigurationLimit(model)]
    task, path = mink.FrameTask("hand", "site", 1.0, 1.0, lm_damping=1e-3), []
    for target in targets:
        task.set_target(mink.SE3.from_matrix(target))
        for _ in range(_MINK_STEPS):
            change = mink.solve_ik(configuration, [task], 1.0, solver="daqp", damping=1e-6, limits=limits)
            configuration.integrate_inplace(change, 1.0)
        path.append(configuration.q.copy())
    return np.stack(path)


def urdf(arm: Embodiment) -> str:
    """URDF of an arm's joints and ranges, with a link `hand` whose axes are those of the base in the zero pose."""
    text, origin, links = "", np.zeros(3), [f"link{joint}" for joint in range(arm.num_joints + 1)]
    for joint, (axis, anchor, low, high) in enumerate(
        zip(arm.joint_axis, arm.joint_anchor, *arm.joint_range.T, strict=True)
    ):
        text += f"""<joint name="j{joint}" type="revolute"><parent link="link{joint}"/><child link="link{joint + 1}"/>
            <origin xyz="{_words(anchor - origin)}"/><axis xyz="{_words(axis)}"/>
            <limit lower="{low}" upper="{high}" velocity="1" effort="1"/></joint>"""
        origin = anchor
    text += f"""<joint name="fixed" type="fixed"><parent link="{links[-1]}"/><child link="hand"/>
        <origin xyz="{_words(arm.hand_position[0] - origin)}"/></joint>"""
    return f'<robot name="arm">{"".join(f"""<link name="{link}"/>""" for link in (*links, "hand"))}{text}</robot>'


def _words(numbers: np.ndarray) -> str:
    return " ".join(map(repr, map(float, numbers)))


def followed_by_pyroki(arm: Embodiment, targets: np.ndarray, start: np.ndarray) -> np.ndarray:
    """PyRoki's least squares from the last pose at each time, with the weights of its examples."""
    import jaxlie  # pyright: ignore[reportMissingImports]
    import jaxls  # pyright: ignore[reportMissingImports]
    import pyroki  # pyright: ignore[reportMissingImports]
    import yourdfpy  # pyright: ignore[reportMissingImports]

    robot = pyroki.Robot.from_urdf(yourdfpy.URDF.load(io.StringIO(urdf(arm))))
    link, joints = jax.numpy.array(robot.links.names.index("hand")), robot.joint_var_cls(0)

    @jax.jit
    def solve(target: jax.Array, last: jax.Array) -> jax.Array:
        costs = [
            pyroki.costs.pose_cost_analytic_jac(
                robot, joints, jaxlie.SE3.from_matrix(target), link, pos_weight=50.0, ori_weight=10.0
            ),
            pyroki.costs.limit_cost(robot, joints, weight=100.0),
            pyroki.costs.rest_cost(joints, last, weight=1e-3),
        ]
        problem = jaxls.LeastSquaresProblem(costs, [joints]).analyze()
        initial = jaxls.VarValues.make([joints.with_value(last)])
        return problem.solve(initial, verbose=False, linear_solver="dense_cholesky")[joints]

    path = [jax.numpy.asarray(start, np.float32)]
    for target in targets @ homogeneous(arm.hand_rotation[0].T, np.zeros(3)):
        path.append(solve(jax.numpy.asarray(target, np.float32), path[-1]))
    return np.stack(path[1:]).astype(float)


def shoulder_elbow_wrist(arm: Embodiment, qpos: np.ndarray) -> np.ndarray:
    """Anchors [3, time, 3] of joints 2, 4 and 6 in the base frame; with fewer joints 2, 3 and the next to last."""
    chosen = (1, 3, 5) if arm.num_joints == 7 else (1, 2, arm.num_joints - 2)
    motions = list(joint_motions(arm, qpos))
    points = [
        motions[joint - 1][..., :3, :3] @ arm.joint_anchor[joint] + motions[joint - 1][..., :3, 3] for joint in chosen
    ]
    return np.stack(points)


def posture(expert: Embodiment, learner: Embodiment, base: Any, qpos: np.ndarray, own: np.ndarray) -> Row:
    """How far elbow, wrist and the plane of shoulder, elbow and wrist are from the expert's at each time."""
    points = [
        shoulder_elbow_wrist(expert, qpos) / float(expert.chain_length),
        shoulder_elbow_wrist(learner, own) @ placement(base).rotation.T / float(learner.chain_length),
    ]
    normals = [np.cross(p[1] - p[0], p[2] - p[0]) for p in points]
    normals = [n / np.maximum(np.linalg.norm(n, axis=-1, keepdims=True), 1e-9) for n in normals]
    cosine = np.abs(np.sum(normals[0] * normals[1], axis=-1))  # a plane has two normals
    _, elbow, wrist = np.linalg.norm(points[0] - points[1], axis=-1)
    return {"elbow": elbow, "wrist": wrist, "plane_deg": np.degrees(np.arccos(np.minimum(cosine, 1)))}


def demonstrations(folder: Path, tasks: tuple[str, ...]) -> Iterator[tuple[str, np.ndarray, float]]:
    """Name, angles and time step of each recorded motion of a Panda."""
    for task in tasks:
        with h5py.File(folder / task / "demo.hdf5") as file:
            states = np.asarray(file["data/demo_1/states"])
        yield task, states[:, 1:8].astype(np.float32), float(np.median(np.diff(states[:, 0])))


def motion_rows(
    expert: Embodiment, name: str, learner: Embodiment, motion: tuple[str, np.ndarray, float]
) -> Iterator[Row]:
    task, qpos, dt = motion
    speeds, metric = np.array(SPEEDS[name]), MetricConfig().build(expert, learner)
    jump, arms = speeds * dt, (expert, learner)
    began = time.perf_counter()
    base = mimic.find_base(*arms, [qpos], **metric.arguments, largest_jump=jump)
    base_s = time.perf_counter() - began
    targets = np.linalg.inv(homogeneous(*placement(base))) @ hand_matrices(expert, qpos.astype(float))

    def imitate() -> Any:
        return jax.device_get(
            mimic.imitate_trajectory(*arms, qpos, **metric.arguments, hand="exact", base=base, largest_jump=jump)
        )

    home = np.asarray(learner.home, float)
    start = followed_by_ssik(learner, targets[:1], home)[0]
    methods: dict[str, Callable[[], np.ndarray]] = {
        "mimic": lambda: imitate().qpos,
        "ssik, seeded": lambda: followed_by_ssik(learner, targets, home),
        "mink": lambda: followed_by_mink(learner, targets, start),
    }
    if find_spec("pyroki"):
        methods["PyRoki"] = lambda: followed_by_pyroki(learner, targets, start)
    for method, solve in methods.items():
        began = time.perf_counter()
        own = np.asarray(solve(), float)
        seconds = time.perf_counter() - began
        position, rotation = errors(learner, own, targets)
        exact = (position <= 1e-4) & (rotation <= np.radians(0.01))
        fastest = np.abs(np.diff(own, axis=0)).max(axis=0) / jump
        yield as_numbers(
            {
                "learner": name,
                "demonstration": task,
                "method": method,
                "frames": len(qpos),
                "base": base.tolist(),
                "base_s": base_s,
                "exact": exact.mean(),
                "position_mm": 1e3 * position.max(),
                "rotation_deg": np.degrees(rotation.max()),
                "fastest": fastest.max(),
                "fps": len(qpos) / seconds,
                **{key: x.mean() for key, x in posture(expert, learner, base, qpos.astype(float), own).items()},
            }
        )


def measure(options: argparse.Namespace, arms: list[tuple[str, Embodiment]]) -> None:
    expert, content = mimic.panda(limits="hardware"), {"random": [], "motions": [], "throughput": []}  # type: ignore[var-annotated]
    for name, learner in arms:
        if options.throughput:
            content["throughput"].append(throughput_row(expert, name, learner, options.throughput))
            write_results(options, **content)
            continue
        if options.poses:
            content["random"].append(random_row(expert, name, learner, options.poses))
            write_results(options, **content)
        if options.demonstrations:
            for motion in demonstrations(Path(options.demonstrations), options.tasks):
                content["motions"] += motion_rows(expert, name, learner, motion)
                write_results(options, **content)
    print_table(content["random"], RANDOM, "random poses")
    print_table(content["motions"], MOTIONS, "demonstrations")
    print_table(content["throughput"], "learner poses exact:.1% first_s:.1f poses_per_s:,.0f slowest:,.0f fastest:,.0f")


def main() -> None:
    parser = make_parser("exact_hands", __doc__, poses=1000, demonstrations=str, tasks=TASKS, throughput=0)
    parser.add_argument("arms", nargs="+", metavar="NAME=FILE")
    options = parser.parse_args()
    measure(options, [arm_of(argument) for argument in options.arms])


if __name__ == "__main__":
    main()
