"""Demonstrations of a Panda on other arms, with `python -m mimic.retarget`, and replayed in robosuite's tasks.

    PYTHON benchmarks/robosuite_replay.py models FOLDER
    python -m benchmarks.transfer FOLDER [--demonstrations DIR] [--arms ur5e ...] [--tasks lift ...] --work DIR
    python -m benchmarks.transfer FOLDER ... --physics PYTHON      # beside it: task success
    python -m benchmarks.transfer FOLDER ... --data DATA           # beside it: recorded teleoperation, again

PYTHON is one with robosuite. FOLDER/NAME/NAME.xml are its arms with the Panda's gripper. The base is from `base=auto`.
Rows are kept in DIR. Those of the same code and folders are not measured again, so that processes with other arms or
tasks share the work, and an interrupted run can be continued.

The check is C MuJoCo's, of the written data set: hands are sites of both models, `exact` are frames within 1 mm and
0.5 deg, `speed` is a fraction of the data sheets' limits, and `depth_mm` how deep links of the learner are in others;
pairs of links that touch in every pose are left out. `gripper` says whether the gripper's values stay as they were.
Round trip: of the Panda's lift to an arm with six joints, back, and again to the arm: errors of the Panda's hand, and
of the joints of both. The Panda has postures to choose from, the other arm has not.

Teleoperation: in DATA/teleop/so101_to_piper an SO-101 leads a Piper joint by joint: the `recorded` mapping. Its
leader's joints become a data set of the Piper by `hand=near`, within the data sheet's speeds; the leader's hand is what
both are judged by.

In physics, `success` is robosuite's at the end; `exact` and `speed` are of what is commanded. Beside mimic, from the
same base: the solution of `ssik` nearest to the last one, `mink`'s quadratic program from the last one, and `copied`
joints.
"""

import argparse
import functools
import json
import os
import shutil
import subprocess
import time
import xml.etree.ElementTree as ET
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import h5py
import mujoco
import numpy as np

from benchmarks.common import measured_code
from benchmarks.common.parser import make_parser
from benchmarks.common.record import Row, print_table, write_results
from benchmarks.exact_hands import SPEEDS, as_numbers, followed_by_mink, followed_by_ssik, homogeneous
from benchmarks.teleoperation import BASE, SPEED, arm, hand_errors, recordings
from mimic.arms.arm import ArmConfig, build_arm
from mimic.arms.compile_check import VELOCITY_LIMIT
from mimic.arms.embodiment import Embodiment
from mimic.arms.link_match import hand_poses
from mimic.base.files import write_atomically
from mimic.commands.config import RetargetConfig
from mimic.commands.retarget import prepare_retargeting
from mimic.envs.config import EnvConfig
from mimic.motions.importing import read_source
from mimic.motions.units import in_rad
from mimic.retargeting.hand_target import placement

ARMS = "ur5e", "iiwa14", "gen3", "jaco", "xarm7"
METHODS = "mimic", "ssik", "mink", "copied"
TASKS = "lift", "stack", "nut-assembly", "pick-place", "door"
PAIRS = "learner task frames exact mm:.3f deg:.3f speed:.2f margin_deg:.1f depth_mm:.1f gripper ok seconds:.0f"
PHYSICS = "learner task method success objects exact:.1% speed:.1f tracking_error_rad:.3f"
TELEOPERATION = "method episodes frames position_mm_p50:.1f position_mm_p95:.1f hand_direction_deg:.2f"
_SITE, _EPISODE = "gripper0_right_grip_site", "data/demo_1"
_WITHOUT_REDUNDANCY = 6  # joints
_POSES = 100  # random ones, in which links that always touch are found


class Model:
    """An arm in C MuJoCo."""

    def __init__(self, path: Path):
        self.model = mujoco.MjModel.from_xml_path(str(path))
        self.data = mujoco.MjData(self.model)
        hinges = np.flatnonzero(self.model.jnt_type == int(mujoco.mjtJoint.mjJNT_HINGE))
        self.address, self.range = self.model.jnt_qposadr[hinges], self.model.jnt_range[hinges]
        self.range[~self.model.jnt_limited[hinges].astype(bool)] = [-np.inf, np.inf]
        lower, upper = np.clip(self.range, -np.pi, np.pi).T
        poses = np.random.default_rng(0).uniform(lower, upper, (_POSES, len(hinges)))
        self.always = set.intersection(*(set(self.depths(qpos)) for qpos in poses))

    def set(self, qpos: np.ndarray) -> None:
        self.data.qpos[self.address] = qpos
        mujoco.mj_fwdPosition(self.model, self.data)

    def hand(self, qpos: np.ndarray) -> np.ndarray:
        """Pose [4, 4] of the hand in the base frame."""
        self.set(qpos)
        site = self.data.site(_SITE)
        return homogeneous(site.xmat.reshape(3, 3), site.xpos)

    def depths(self, qpos: np.ndarray) -> dict[tuple[int, int], float]:
        """How deep bodies are in others [m], by their numbers."""
        self.set(qpos)
        bodies = self.model.geom_bodyid
        contacts = [self.data.contact[i] for i in range(self.data.ncon)]
        return {(int(bodies[c.geom1]), int(bodies[c.geom2])): -float(c.dist) for c in contacts}


def with_speeds(folder: str, name: str) -> Path:
    """The file of an arm, which states the velocity limits of its data sheet."""
    path = Path(folder) / name / f"{name}_with_speeds.xml"
    root = ET.parse(path.with_name(f"{name}.xml")).getroot()
    custom = root.find("custom")
    custom = ET.SubElement(root, "custom") if custom is None else custom
    ET.SubElement(custom, "numeric", name=VELOCITY_LIMIT, data=" ".join(map(str, SPEEDS[name])))
    partial = path.with_name(f"{path.name}.{os.getpid()}")  # processes that share the work may write at the same time
    partial.write_text(ET.tostring(root, encoding="unicode"))
    os.replace(partial, path)
    return path


def retarget(source: Path, expert: Path, learner: Path, out: Path, base: Any) -> dict[str, Any]:
    """The report of the command, and its seconds."""
    shutil.rmtree(out, ignore_errors=True)  # of an interrupted run
    env = EnvConfig(expert=ArmConfig(model=str(expert)), learner=ArmConfig(model=str(learner)))
    began = time.perf_counter()
    work = prepare_retargeting(RetargetConfig(source=str(source), env=env, out=str(out), base=base, failing="kept"))
    assert work() == 0
    return {**json.loads((out / "report.json").read_text()), "seconds": time.perf_counter() - began}


def learner_motion(out: Path) -> dict[str, np.ndarray]:
    """Angles and the gripper's values of a data set that was written."""
    with h5py.File(out / "demo.hdf5") as file:
        entries = {"qpos": "obs/robot0_joint_pos", "gripper": "obs/robot0_gripper_qpos", "actions": "actions"}
        return {key: np.asarray(file[f"{_EPISODE}/{entry}"], float) for key, entry in entries.items()}


def targets(expert: Model, qpos: np.ndarray, base: list[float]) -> np.ndarray:
    """Hands [time, 4, 4] of the expert in the learner's base frame."""
    return np.linalg.inv(homogeneous(*placement(base))) @ np.stack([expert.hand(pose) for pose in qpos])


def of_arm(arm: Embodiment, model: Model, hands: np.ndarray) -> np.ndarray:
    """Poses [time, 4, 4] of the site as those of the arm's hand, whose axes may be others."""
    qpos = np.asarray(arm.home, float)
    return hands @ np.linalg.inv(model.hand(qpos)) @ hand_poses(arm, qpos)[0]


def check(learner: Model, qpos: np.ndarray, hands: np.ndarray, dt: float, speeds: list[float]) -> Row:
    """What C MuJoCo says of a motion."""
    own = np.stack([learner.hand(pose) for pose in qpos])
    position = np.linalg.norm(own[:, :3, 3] - hands[:, :3, 3], axis=1)
    chord = np.linalg.norm(own[:, :3, :3] - hands[:, :3, :3], axis=(1, 2)) / np.sqrt(8)
    rotation = 2 * np.arcsin(np.minimum(chord, 1))
    depths = [max((d for p, d in learner.depths(q).items() if p not in learner.always), default=0.0) for q in qpos]
    margin = np.minimum(qpos - learner.range[:, 0], learner.range[:, 1] - qpos).min()
    return {
        "exact": int(np.sum((position <= 1e-3) & (rotation <= np.radians(0.5)))),
        "mm": 1e3 * position.max(),
        "deg": np.degrees(rotation.max()),
        "speed": (np.abs(np.diff(qpos, axis=0)) / dt / speeds).max(),
        "margin_deg": np.degrees(margin),
        "depth_mm": 1e3 * max(depths),
    }


def pair_row(options: argparse.Namespace, expert: Model, name: str, learner: Model, task: str) -> Row:
    """A demonstration on an arm, checked."""
    folder = Path(options.folder)
    source, out = Path(options.demonstrations) / task / "demo.hdf5", Path(options.work) / f"{task}_{name}"
    with h5py.File(source) as file:
        states, actions = (np.asarray(file[f"{_EPISODE}/{key}"], float) for key in ("states", "actions"))
    report = retarget(source, folder / "panda/panda.xml", with_speeds(options.folder, name), out, "auto")
    (episode,), motion, dt = report["episodes"], learner_motion(out), float(np.median(np.diff(states[:, 0])))
    np.save(out.with_suffix(".npy"), motion["qpos"])
    hands = targets(expert, states[:, 1:8], report["base"])
    same = np.array_equal(motion["gripper"], states[:, 8:10]) and np.array_equal(motion["actions"], actions)
    checked = check(learner, motion["qpos"], hands, dt, SPEEDS[name])
    causes = [f"{x['cause']}, frames {x['first']} to {x['last']}" for x in episode["failures"]]
    row = {"learner": name, "task": task, "frames": len(states), **checked, "gripper": same, "ok": episode["ok"]}
    return as_numbers({**row, "seconds": report["seconds"], "base": report["base"], "failures": causes})


def round_trip(options: argparse.Namespace, expert: Model, name: str) -> Row:
    """The Panda's lift on an arm, back on the Panda, and again on the arm."""
    work, panda, arm = Path(options.work), Path(options.folder) / "panda/panda.xml", with_speeds(options.folder, name)
    there, back, again = (work / f"lift_{name}{end}" for end in ("", "_panda", f"_panda_{name}"))
    base = json.loads((there / "report.json").read_text())["base"]
    x, y, z, yaw = base
    cosine, sine = np.cos(yaw), np.sin(yaw)
    inverse = [float(number) for number in (-cosine * x - sine * y, sine * x - cosine * y, -z, -yaw)]
    retarget(there / "demo.hdf5", arm, panda, back, inverse)
    retarget(back / "demo.hdf5", panda, arm, again, base)
    with h5py.File(Path(options.demonstrations) / "lift/demo.hdf5") as file:
        recorded = np.asarray(file[f"{_EPISODE}/states"], float)[:, 1:8]
    first, returned, last = (learner_motion(folder)["qpos"] for folder in (there, back, again))
    row = check(expert, returned, targets(expert, recorded, [0.0] * 4), 0.05, SPEEDS["panda"])
    rad = {"expert_rad": np.abs(returned - recorded).max(), "learner_rad": np.abs(last - first).max()}
    return as_numbers({"learner": name, "mm": row["mm"], "deg": row["deg"], **rad})


def teleoperation(options: argparse.Namespace) -> Iterator[Row]:
    """The recorded leader's episodes as a data set of the Piper, and what the recording's own mapping did."""
    options.data, options.robots, options.episodes = Path(options.data), Path(), None  # of benchmarks.teleoperation
    out = Path(options.work) / "so101_to_piper"
    model = ET.parse(options.data / "arms/piper.urdf")
    for number, speed in enumerate(SPEED["piper"], start=1):
        limit = model.find(f"joint[@name='joint{number}']/limit")
        assert limit is not None
        limit.set("velocity", str(speed))
    model.write(piper := Path(options.work) / "piper.urdf")
    env = EnvConfig(
        expert=ArmConfig(model=str(options.data / "arms/so101/so101_new_calib.urdf")),
        learner=ArmConfig(model=str(piper)),
    )
    source, began = options.data / "teleop/so101_to_piper", time.perf_counter()
    config = {"source": str(source), "units": "deg", "hand": "near", "base": BASE, "failing": "kept"}
    work = prepare_retargeting(RetargetConfig(**config, env=env, out=str(out)))
    assert work() == 0
    seconds = time.perf_counter() - began
    leader, follower = arm("so101", options), build_arm(env.learner, "hardware").embodiment
    written = in_rad(read_source(out, follower.joint_names, "action", None), "deg", follower.joint_range)
    qpos = np.concatenate(recordings(leader, "deg", options))
    ways = {
        "mimic": (BASE, np.concatenate([motion.qpos for motion in written.motions.values()])),
        "recorded": (None, np.concatenate(recordings(follower, "percent", options))),
    }
    for method, (base, own) in ways.items():
        row = {"method": method, "episodes": len(written.motions), "frames": len(own)}
        row |= hand_errors(leader, follower, base, qpos, own)
        steps = [np.abs(np.diff(motion.qpos, axis=0)).max(axis=0) for motion in written.motions.values()]
        if method == "mimic":
            row |= {"speed": (np.max(steps, axis=0) * 15 / SPEED["piper"]).max(), "seconds": seconds}
        yield as_numbers(row)


def in_physics(options: argparse.Namespace, expert: Model, method: str, row: Row) -> list[Row]:
    """Task success of an arm's motion by a method: the Panda's own, mimic's, copied joints or those of seeded IK."""
    work, name, task = Path(options.work).absolute(), row["learner"], row["task"]
    arm = build_arm(ArmConfig(model=str(with_speeds(options.folder, name))), "hardware").embodiment
    folder, path = Path(options.demonstrations).absolute() / task, work / f"{task}_{name}_{method}.npy"
    with h5py.File(folder / "demo.hdf5") as file:
        states = np.asarray(file[f"{_EPISODE}/states"], float)
    qpos, learner = states[:, 1:8], Model(Path(options.folder) / name / f"{name}.xml")
    hands = targets(expert, qpos, row["base"])
    if method == "mimic":
        qpos = np.load(work / f"{task}_{name}.npy")
    elif method in ("ssik", "mink"):
        own = of_arm(arm, learner, hands)
        start = followed_by_ssik(arm, own[:1], np.asarray(arm.home, float))[0]
        qpos = {"ssik": followed_by_ssik, "mink": followed_by_mink}[method](arm, own, start)
    elif method == "copied":
        qpos = np.clip(qpos[:, : arm.num_joints], *arm.joint_range.T)
    np.save(path, qpos)
    checked = check(learner, qpos, hands, float(np.median(np.diff(states[:, 0]))), SPEEDS[name])
    of_motion = {"exact": checked["exact"] / len(qpos), "speed": checked["speed"]}
    job = {"task": task, "robot": name, "method": method, "base": row["base"], "motion": str(path)}
    files = [work / f"{kind}_{task}_{name}_{method}.json" for kind in ("jobs", "replays")]
    files[0].write_text(json.dumps([{**job, "demonstration": str(folder)}]))
    script = Path(__file__).with_name("robosuite_replay.py")
    environment = {key: value for key, value in os.environ.items() if key != "PYTHONPATH"}
    subprocess.run([options.physics, str(script), "replay", *map(str, files)], check=True, env=environment)
    keys = "task", "method", "success", "ever", "objects", "tracking_error_rad"
    results = json.loads(files[1].read_text())
    rows = ({"learner": result["robot"], **{key: result[key] for key in keys}, **of_motion} for result in results)
    return [as_numbers(row) for row in rows]


def kept(options: argparse.Namespace, path: Path, measure: Callable[[], Any]) -> Any:
    """A row, or rows, from a file if that is of the same code and folders, or measured and written there."""
    code = measured_code.hashes(options.benchmark)
    for folder in (measured_code.PACKAGE / "commands", Path(__file__).resolve().parent):
        code[folder.name] = measured_code.hash_of(folder)
    code |= {name: str(Path(getattr(options, name)).resolve()) for name in ("folder", "demonstrations")}
    if path.exists() and (content := json.loads(path.read_text()))["code"] == code:
        return content["rows"]
    rows = measure()
    write_atomically(path, json.dumps({"code": code, "rows": rows}))
    return rows


def main(arguments: list[str] | None = None) -> None:
    parser = make_parser(
        "transfer", __doc__, demonstrations="../shared/data/robosuite_demos", work="transfer", arms=ARMS, tasks=TASKS,
        methods=METHODS, physics="", data="",
    )  # fmt: skip
    parser.add_argument("folder")
    options = parser.parse_args(arguments)
    Path(options.work).mkdir(parents=True, exist_ok=True)
    expert = Model(Path(options.folder) / "panda/panda.xml")
    content: dict[str, list[Row]] = {"pairs": [], "round_trip": [], "physics": []}
    for name in options.arms:
        learner = Model(Path(options.folder) / name / f"{name}.xml")
        for task in options.tasks:
            measure = functools.partial(pair_row, options, expert, name, learner, task)
            content["pairs"].append(kept(options, Path(options.work) / f"{task}_{name}.json", measure))
            write_results(options, **content)
            print_table(content["pairs"][-1:], PAIRS)
        if "lift" in options.tasks and len(learner.range) == _WITHOUT_REDUNDANCY:
            measure = functools.partial(round_trip, options, expert, name)
            content["round_trip"].append(kept(options, Path(options.work) / f"round_trip_{name}.json", measure))
    own = [{"learner": "panda", "task": task, "base": [0.0] * 4} for task in options.tasks]
    for method in ("recorded", *options.methods) if options.physics else ():
        for name in options.arms if method in METHODS else ("panda",):
            for row in (row for row in own + content["pairs"] if row["learner"] == name):
                path = Path(options.work) / f"physics_{row['task']}_{name}_{method}.json"
                content["physics"] += kept(options, path, functools.partial(in_physics, options, expert, method, row))
            write_results(options, **content)
    if options.data:
        path = Path(options.work) / "teleoperation.json"
        content["teleoperation"] = kept(options, path, lambda: list(teleoperation(options)))
    write_results(options, **content)
    print_table(content["pairs"], PAIRS, "pairs")
    print_table(content["round_trip"], "learner mm:.4f deg:.4f expert_rad:.4f learner_rad:.4f", "round trip of lift")
    print_table(content.get("teleoperation", []), TELEOPERATION, "teleoperation")
    print_table(content["physics"], PHYSICS, "physics")


if __name__ == "__main__":
    main()
