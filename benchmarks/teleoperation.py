"""Live teleoperation: followers of another build within their limits, whatever the leader sends.

    python -m benchmarks.teleoperation --data FOLDER --robots FOLDER [--parts PART ...] [--out FILE]

FOLDER of `--data` has arms/ and teleop/so101_to_piper, that of `--robots` the arms of robosuite; `--clip` is a captured
person. Episodes: the recorded leader (SO-101) drives a Piper, at the recorded rate and resampled to 100 Hz. The
`recorded` follower is what the recording's own mapping did. `bound`: fraction of the frames with an embodiment distance
within 5 % of that of `imitate_pose`, which has no limits of speed. Sweeps: a leader wanders through all of its joint
ranges, while 30 % of the samples are lost, stall for 2 s, jump, are not finite, or have times that run backwards.
Limits are checked by differences of the commands, and `clearance_mm` is the smallest distance of capsules around the
follower's links, where its model has shapes; `recovery` is the time from the first good sample after a fault to
the first command that follows samples again. Postures: a recorded Panda lifts a cube, and arms with seven joints follow
from a base of `find_base`; ssik's Tracker and mink start in the same posture. Times: of one step, beside
ssik's Tracker and mink.
"""

import argparse
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import jax
import numpy as np

import mimic
from benchmarks.common.parser import make_parser
from benchmarks.common.record import Row, print_table, write_results
from benchmarks.exact_hands import (
    SPEEDS,
    as_numbers,
    demonstrations,
    hand_matrices,
    homogeneous,
    mink_model,
    posture,
    ssik_solver,
)
from mimic.arms.arm import ArmConfig, build_arm
from mimic.arms.embodiment import Embodiment
from mimic.control.clearance import clearance
from mimic.metric.capsule_distances import clearance_constants
from mimic.metric.config import MetricConfig
from mimic.motions.importing import read_source, source_names
from mimic.motions.units import in_rad
from mimic.retargeting.exact_chunks import in_chunks
from mimic.retargeting.hand_target import placement
from mimic.retargeting.self_contacts import SelfContacts

EPISODES = (
    "method rate frames position_mm_p95:.2f hand_direction_deg:.2f bound:.1% of_limits:.3f elbow:.3f plane_deg:.1f"
)
SWEEPS = "pair steps not_finite beyond_mrad:.6f of_limits:.4f recovery_s:.2f holding:.1% clearance_mm:.1f"
POSTURES = (
    "follower method position_mm_p50:.2f position_mm_p95:.2f hand_direction_deg:.2f elbow:.3f plane_deg:.1f "
    "distance:.4f"
)
TIMES = "method p50_ms:.3f p99_ms:.3f p999_ms:.3f"
# rad/s (data sheets); Piper's model states 0 for its first joint, those of robosuite nothing.
SPEED = {
    "piper": [3.14, 3.40, 3.14, 3.92, 3.92, 3.92],
    "panda": SPEEDS["panda"],
    "so101": [4.7] * 5,
    "ur5e": SPEEDS["ur5e"],
    "iiwa": SPEEDS["iiwa14"],
    "kinova3": SPEEDS["gen3"],
    "jaco": SPEEDS["jaco"],
}
BASE = [0.0, 0.115, 0.03, -0.535]  # of the Piper in the SO-101's base frame, from `find_base`, rounded
PAIRS = ("panda-ur5e", "ur5e-panda", "so101-panda", "panda-so101", "person-panda")
FAULTS = ("lost", "stalled", "jumped", "displaced", "not finite", "backwards")
REDUNDANT = ("iiwa", "kinova3", "jaco")  # followers of a Panda
CHUNK = 2048  # poses that are compared at a time
_RATE, _LOST, _TIMED = 100.0, 0.3, 3  # Hz; fraction of samples that are lost; episodes


def config(name: str, options: argparse.Namespace) -> ArmConfig:
    files = {
        "so101": options.data / "arms/so101/so101_new_calib.urdf",
        "piper": options.data / "arms/piper.urdf",
    }
    return (
        ArmConfig() if name == "panda" else ArmConfig(model=str(files.get(name, options.robots / name / "robot.xml")))
    )


def arm(name: str, options: argparse.Namespace) -> Embodiment:
    return build_arm(config(name, options), "hardware").embodiment


def clearance_of(operator: mimic.Teleoperator, capsules: mimic.Capsules) -> Callable[[np.ndarray], float]:
    """The smallest distance [mm] of the follower's checked capsules on a path, by NumPy, as on a robot."""
    pairs = SelfContacts(operator.follower, capsules).pairs
    constants = clearance_constants(operator.follower, capsules, floor_height=-10.0, pairs=pairs)
    return lambda path: 1e3 * float(clearance(path, constants).min())


def person(clip: Path, folder: str) -> tuple[ArmConfig, np.ndarray]:
    """The right arm of a captured person, whose model is written to a folder, and its poses at 100 Hz."""
    from mimic.commands.capture import read_arm
    from mimic.commands.config import CaptureConfig
    from mimic.motions.mocap.ball_chain import ball_chain_motion, ball_chain_xml, zero_frames

    part = max(read_arm(clip, "right", CaptureConfig()).parts, key=lambda part: len(part.start))
    zero = zero_frames(part)
    (path := Path(folder) / "person.xml").write_text(ball_chain_xml(part, zero))
    qpos = np.unwrap(ball_chain_motion(part, zero)[0], axis=0)
    return ArmConfig(model=str(path)), resampled(qpos, part.rate)


def resampled(qpos: np.ndarray, rate: float) -> np.ndarray:
    times = np.arange(0, (len(qpos) - 1) / rate, 1 / _RATE) * rate
    return np.stack([np.interp(times, np.arange(len(qpos)), column) for column in qpos.T], axis=1)


def ratios(path: np.ndarray, operator: mimic.Teleoperator, rate: float) -> tuple[float, float, int]:
    """Largest speed, acceleration or jerk over its limit, how far beyond the ranges [mrad], number of violations."""
    limits, largest, count, differences = operator.limits, 0.0, 0, path
    for limit in (limits.velocity, limits.acceleration, limits.jerk):
        differences = np.diff(differences, axis=0) * rate
        fraction = np.abs(differences) / limit
        largest, count = max(largest, fraction.max()), count + int((fraction > 1 + 1e-6).sum())
    lower, upper = limits.position.T
    beyond = np.maximum(lower - path, path - upper).max()
    return float(largest), 1e3 * float(beyond), count


def resemblance(leader: Embodiment, follower: Embodiment, base: Any, qpos: np.ndarray, own: np.ndarray) -> Row:
    """Mean distance of elbows and wrists [chain lengths], and angle of the planes of shoulder, elbow and wrist."""
    return {key: x.mean() for key, x in posture(leader, follower, base, qpos, own).items()}


def driven(operator: mimic.Teleoperator, leader_qpos: np.ndarray) -> tuple[np.ndarray, np.ndarray, list[str]]:
    """Commands, seconds of each step, and states; engaged on the first pose until its hand is reached or nearest."""
    operator.engage()
    while operator.step(leader_qpos[0]).status.state not in ("tracking", "nearest"):
        pass
    path, seconds, states = [], [], []
    for sample in leader_qpos:
        began = time.perf_counter()
        command = operator.step(sample)
        seconds.append(time.perf_counter() - began)
        path.append(command.qpos)
        states.append(command.status.state)
    return np.array(path), np.array(seconds), states


def recordings(embodiment: Embodiment, unit: str, options: argparse.Namespace) -> list[np.ndarray]:
    """Recorded angles of each episode [rad]; the leader's go beyond its model's ranges."""
    source = read_source(options.data / "teleop/so101_to_piper", source_names(embodiment, ()), "", None)
    angles = in_rad(source, unit, np.asarray(embodiment.joint_range))
    return [motion.qpos for motion in angles.motions.values()][: options.episodes]


def episodes(options: argparse.Namespace) -> Iterator[Row]:
    leader, follower = arm("so101", options), arm("piper", options)
    paths, recorded = recordings(leader, "deg", options), recordings(follower, "percent", options)
    metric = MetricConfig().build(leader, follower)
    nearest = jax.jit(
        lambda qpos: mimic.imitate_pose(leader, follower, qpos, **metric.arguments, hand="exact", base=BASE)
    )
    distance = distance_of(leader, follower, BASE)
    for rate in (15.0, _RATE):
        paths = paths if rate != _RATE else [resampled(path, 15.0) for path in paths]
        qpos = np.concatenate(paths)
        operator = mimic.Teleoperator(leader, follower, base=BASE, rate=rate, velocity=SPEED["piper"])
        runs = [driven(operator, path)[0] for path in paths]
        judged = slice(None, None, round(rate / 15))  # as many as were recorded
        bound = np.concatenate(
            [np.asarray(nearest(chunk).distance) for chunk in in_chunks(qpos[judged].astype(np.float32), CHUNK)]
        )
        ways = {"mimic": np.concatenate(runs)}
        if rate != _RATE:
            ways["recorded"] = np.concatenate(recorded)
        of_limits = [ratios(run, operator, rate) for run in runs]
        for method, own in ways.items():
            mine, base = method == "mimic", BASE if method == "mimic" else None
            pairs = zip(*(in_chunks(x[judged].astype(np.float32), CHUNK) for x in (qpos, own)), strict=True)
            within = np.concatenate([np.asarray(distance(*pair)) for pair in pairs]) <= 1.05 * bound + 1e-6
            row = {"method": method, "rate": rate, "frames": len(qpos)}
            row |= hand_errors(leader, follower, base, qpos, own) | resemblance(leader, follower, base, qpos, own)
            if mine:
                row |= {"bound": within[: len(qpos[judged])].mean(), "violations": sum(x[2] for x in of_limits)}
                row |= {"of_limits": max(x[0] for x in of_limits)}
            yield as_numbers(row)


def distance_of(leader: Embodiment, follower: Embodiment, base: Any) -> Callable[..., Any]:
    """The embodiment distance by the default metric, of postures of both arms [time, joints]."""
    metric = MetricConfig().build(leader, follower)
    return jax.jit(jax.vmap(lambda q, own: metric(*states(leader, follower, base, q, own))))


def states(leader: Embodiment, follower: Embodiment, base: Any, qpos: Any, own: Any) -> tuple[Any, Any]:
    """Link states of both arms in the axes of the follower's base."""
    rotation = placement(base).rotation.T
    turned = jax.tree.map(lambda x: x @ rotation.T, mimic.link_states(leader, qpos))
    return turned, mimic.link_states(follower, own)


def hand_errors(leader: Embodiment, follower: Embodiment, base: Any, qpos: np.ndarray, own: np.ndarray) -> Row:
    """Distance of the hands, and the mean angle of their approaches."""
    targets = np.linalg.inv(homogeneous(*placement(base))) @ hand_matrices(leader, qpos)
    hands = hand_matrices(follower, own)
    apart = 1e3 * np.linalg.norm(hands[:, :3, 3] - targets[:, :3, 3], axis=1)
    cosine = np.clip(np.sum(hands[:, :3, 2] * targets[:, :3, 2], axis=1), -1, 1)
    return {
        "position_mm_p50": np.median(apart),
        "position_mm_p95": np.percentile(apart, 95),
        "hand_direction_deg": np.degrees(np.arccos(cosine)).mean(),
    }


def wander(leader: Embodiment, steps: int, rng: np.random.Generator) -> np.ndarray:
    """A smooth motion through all of the joint ranges, with the speed of a person's hand."""
    lower, upper = leader.joint_range.T
    lower, upper = np.maximum(lower, -np.pi), np.minimum(upper, np.pi)
    times, waves = np.arange(steps)[:, None] / _RATE, 0.0
    for _ in range(3):
        frequency, phase = rng.uniform(0.03, 0.25, leader.num_joints), rng.uniform(0, 2 * np.pi, leader.num_joints)
        waves = waves + np.sin(2 * np.pi * frequency * times + phase)
    return (lower + upper) / 2 + (upper - lower) / 2 * np.clip(waves / 2, -1, 1)


def sweep(name: str, options: argparse.Namespace, block: int = 20000) -> Row:
    """A leader with faults, and what its follower did."""
    one, other = name.split("-")
    follower, rng = arm(other, options), np.random.default_rng(PAIRS.index(name))
    with tempfile.TemporaryDirectory() as folder:
        model, clip = person(options.clip, folder) if one == "person" else (config(one, options), None)
        leader = build_arm(model, "hardware").embodiment
    scale = float(follower.chain_length / leader.chain_length)
    capsules = None if other == "so101" else mimic.fit_capsules(config(other, options), "hardware")  # it has no shapes
    operator = mimic.Teleoperator(leader, follower, scale=scale, velocity=SPEED[other], rate=_RATE, capsules=capsules)
    smallest = clearance_of(operator, capsules) if capsules else None
    row: Row = {"pair": name, "steps": 0, "not_finite": 0, "violations": 0, "of_limits": 0.0, "beyond_mrad": -np.inf}
    recoveries, holding, begin = [], 0, None
    operator.engage()
    while row["steps"] < options.steps:
        motion = wander(leader, block, rng) if clip is None else clip[np.arange(block) % (2 * len(clip)) - len(clip)]
        path, of_block, held = faulty(operator, motion, rng)
        before = path if begin is None else np.concatenate([begin, path])  # across blocks too
        largest, beyond, count = ratios(before, operator, _RATE)
        begin, recoveries, holding = path[-3:], recoveries + of_block, holding + held
        row |= {"steps": row["steps"] + block, "not_finite": row["not_finite"] + int((~np.isfinite(path)).sum())}
        row |= {"violations": row["violations"] + count, "of_limits": max(row["of_limits"], largest)}
        row["beyond_mrad"] = max(row["beyond_mrad"], beyond)
        if smallest is not None:
            row["clearance_mm"] = min(row.get("clearance_mm", np.inf), smallest(path))
    recovery = {"recoveries": len(recoveries), "recovery_s": max(recoveries), "holding": holding / row["steps"]}
    return as_numbers(row | recovery)


def faulty(
    operator: mimic.Teleoperator, motion: np.ndarray, rng: np.random.Generator
) -> tuple[np.ndarray, list[float], int]:
    """Commands of a motion with a fault of a random kind each 4 s, times of recovery [s], and ticks of holding."""
    path, recoveries, holding, clock, waiting = [], [], 0, 0.0, None
    for tick, sample in enumerate(motion):
        phase, kind = tick % 400, FAULTS[(tick // 400) % len(FAULTS)]
        has_fault = phase < (200 if kind == "stalled" else 40)
        sent: Any = None if rng.random() < _LOST else sample
        clock += 1 / _RATE
        stamp = clock
        if has_fault and sent is not None:
            if kind in ("lost", "stalled"):
                sent = None
            elif kind == "jumped":
                sent = sample + rng.uniform(-2, 2, len(sample))
            elif kind == "displaced":  # a jump to where the leader then is
                sent = sample + 0.5
            elif kind == "not finite":
                sent = np.where(rng.random(len(sample)) < 0.5, rng.choice([np.nan, np.inf]), sample)
            else:
                stamp = clock - rng.uniform(0, 100)
        command = operator.step(sent, time=stamp)
        path.append(command.qpos)
        holding += command.status.state == "holding"
        if has_fault:
            waiting = -1
        elif waiting is not None:
            waiting = tick if waiting == -1 and sent is not None else waiting
            follows = command.status.state != "holding" and "ignored" not in command.status.reason and sent is not None
            if waiting >= 0 and follows:
                recoveries.append((tick - waiting) / _RATE)
                waiting = None
    return np.array(path), recoveries, holding


def postures(options: argparse.Namespace) -> Iterator[Row]:
    ((_, recorded, dt),) = demonstrations(options.data / "robosuite_demos", ("lift",))
    leader, qpos = arm("panda", options), resampled(recorded.astype(float), 1 / dt)
    for name in REDUNDANT:
        follower, speed = arm(name, options), SPEED[name]
        metric = MetricConfig().build(leader, follower)
        base = mimic.find_base(leader, follower, [recorded], **metric.arguments, largest_jump=np.multiply(speed, dt))
        targets = np.linalg.inv(homogeneous(*placement(base))) @ hand_matrices(leader, qpos)
        operator = mimic.Teleoperator(leader, follower, base=base, velocity=speed, rate=_RATE)
        own = {"mimic": driven(operator, qpos)[0]}
        own["mink"], _ = tracked_by_mink(follower, targets, own["mimic"][0], speed)
        own["ssik's Tracker"], _ = tracked_by_ssik(follower, targets, own["mimic"][0], speed)
        distance = distance_of(leader, follower, base)
        for method, path in own.items():
            row = hand_errors(leader, follower, base, qpos, path) | resemblance(leader, follower, base, qpos, path)
            row |= {"distance": float(distance(qpos, path).mean())}
            yield as_numbers({"follower": name, "method": method, "steps": len(path), **row})


def times(options: argparse.Namespace) -> Iterator[Row]:
    leader, follower = arm("so101", options), arm("piper", options)
    qpos = np.concatenate([resampled(path, 15.0) for path in recordings(leader, "deg", options)[:_TIMED]])
    targets = np.linalg.inv(homogeneous(*placement(BASE))) @ hand_matrices(leader, qpos)
    operator = mimic.Teleoperator(leader, follower, base=BASE, velocity=SPEED["piper"], rate=_RATE)
    methods: dict[str, Callable[[], tuple[np.ndarray, np.ndarray]]] = {
        "mimic": lambda: driven(operator, qpos)[:2],
        "mink": lambda: tracked_by_mink(follower, targets, operator.step(None).qpos, SPEED["piper"]),
        "ssik's Tracker": lambda: tracked_by_ssik(follower, targets, operator.step(None).qpos, SPEED["piper"]),
    }
    for method, run in methods.items():
        own, seconds = run()
        row = {"method": method, "steps": len(own), **hand_errors(leader, follower, BASE, qpos, own)}
        row |= dict(zip(("p50_ms", "p99_ms", "p999_ms"), 1e3 * np.percentile(seconds, [50, 99, 99.9]), strict=True))
        row |= {"of_limits": ratios(own, operator, _RATE)[0], **resemblance(leader, follower, BASE, qpos, own)}
        yield as_numbers(row)


def tracked_by_ssik(
    follower: Embodiment, targets: np.ndarray, start: np.ndarray, speed: list[float]
) -> tuple[np.ndarray, np.ndarray]:
    import ssik

    manipulator, back = ssik_solver(follower)
    tracker, path, seconds = ssik.Tracker(manipulator, start, max_joint_speed=speed), [], []
    for tick, target in enumerate(targets):
        began = time.perf_counter()
        step = tracker.update(target @ back, tick / _RATE)
        seconds.append(time.perf_counter() - began)
        path.append(np.asarray(step.q, float))
    return np.array(path), np.array(seconds)


def tracked_by_mink(
    follower: Embodiment, targets: np.ndarray, start: np.ndarray, speed: list[float]
) -> tuple[np.ndarray, np.ndarray]:
    """One step of mink's inverse kinematics for each target, within the limits of position and velocity."""
    import mink

    model = mink_model(follower)
    configuration = mink.Configuration(model, start)
    speeds = dict(zip(follower.joint_names, speed, strict=True))
    limits = [mink.ConfigurationLimit(model), mink.VelocityLimit(model, speeds)]
    task, path, seconds = mink.FrameTask("hand", "site", 1.0, 1.0, lm_damping=1e-3), [], []
    for target in targets:
        began = time.perf_counter()
        task.set_target(mink.SE3.from_matrix(target))
        velocity = mink.solve_ik(configuration, [task], 1 / _RATE, solver="daqp", damping=1e-6, limits=limits)
        configuration.integrate_inplace(velocity, 1 / _RATE)
        seconds.append(time.perf_counter() - began)
        path.append(configuration.q.copy())
    return np.array(path), np.array(seconds)


def main() -> None:
    parser = make_parser(
        "teleoperation",
        __doc__,
        parts=("episodes", "sweeps", "postures", "times"),
        pairs=PAIRS,
        steps=20000,
        episodes=55,
        **dict.fromkeys(("data", "robots", "clip"), Path),
    )
    options = parser.parse_args()
    parts: dict[str, tuple[str, Callable[[], Iterator[Row]]]] = {
        "episodes": (EPISODES, lambda: episodes(options)),
        "sweeps": (SWEEPS, lambda: (sweep(name, options) for name in options.pairs)),
        "postures": (POSTURES, lambda: postures(options)),
        "times": (TIMES, lambda: times(options)),
    }
    content: dict[str, list[Row]] = {part: [] for part in parts}
    for part in options.parts:
        for row in parts[part][1]():
            content[part].append(row)
            write_results(options, **content)
    for part, (columns, _) in parts.items():
        print_table(content[part], columns, part)


if __name__ == "__main__":
    main()
