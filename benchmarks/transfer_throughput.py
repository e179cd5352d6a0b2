"""Speed of `python -m mimic.retarget`: frames a second after compilation, and the time of a whole command.

    python -m benchmarks.transfer_throughput FOLDER [--demonstrations DIR] [--arms ur5e ...] [--frames 4000] --work DIR

FOLDER/NAME/NAME.xml are robosuite's arms with the Panda's gripper, from `benchmarks/robosuite_replay.py models`; the
expert is the Panda of the package. The data set has the recordings of the five tasks again and again until there are
enough frames, each with another angle of the first joint, so that no two episodes are the same.

`command_s` is of `python -m mimic.retarget` from its start to its end with base=auto and an empty compilation cache, on
the recordings alone. The base that it finds is then used for the whole data set in this process, with what the command
compiled; reading, retargeting, certifying and writing are timed the second time: `frames_per_s`.
"""

import argparse
import json
import os
import shutil
import subprocess
import sys
import time
from pathlib import Path

import h5py
import numpy as np

from benchmarks.common.parser import make_parser
from benchmarks.common.record import Row, collect
from benchmarks.exact_hands import as_numbers
from benchmarks.transfer import TASKS, with_speeds
from mimic.arms.arm import ArmConfig
from mimic.commands.config import RetargetConfig
from mimic.commands.retarget import prepare_retargeting
from mimic.envs.config import EnvConfig

COLUMNS = "learner episodes frames exact:.1% ok:.1% seconds:.1f frames_per_s:,.0f command_frames command_s:.1f"
_TURN = 0.1  # rad, at most, by which the first joint of an episode is shifted
_DT = 0.05  # s, of the recordings


def write_episodes(path: Path, demonstrations: Path, frames: int) -> None:
    """Writes a data set of each task's recording, and as many more of them as give so many frames."""
    random, episodes, written = np.random.default_rng(0), 0, 0
    with h5py.File(path, "w") as file:
        while episodes < len(TASKS) or written < frames:
            with h5py.File(demonstrations / TASKS[episodes % len(TASKS)] / "demo.hdf5") as source:
                states = np.asarray(source["data/demo_1/states"], float)
            qpos = states[:, 1:8] + np.eye(7)[0] * random.uniform(-_TURN, _TURN)
            episodes, written = episodes + 1, written + len(qpos)
            group = file.create_group(f"data/demo_{episodes}")
            group["obs/robot0_joint_pos"], group["obs/robot0_gripper_qpos"] = qpos, states[:, 8:10]
            group["time"] = _DT * np.arange(len(qpos))


def command(source: Path, learner: Path, out: Path, cache: Path) -> Row:
    """The whole command in a process of its own, and its report."""
    for folder in (out, cache):
        shutil.rmtree(folder, ignore_errors=True)
    arms = f"source={source}", "expert=panda", f"learner={learner}", f"out={out}"
    keys = "base=auto", "failing=kept", f"compilation_cache={cache}"
    began = time.perf_counter()
    subprocess.run([sys.executable, "-m", "mimic.retarget", *arms, *keys], check=True)
    seconds = time.perf_counter() - began
    report = json.loads((out / "report.json").read_text())
    frames = sum(episode["frames"] for episode in report["episodes"])
    return {"base": report["base"], "command_frames": frames, "command_s": seconds}


def whole(source: Path, learner: Path, out: Path, cache: Path, base: list[float]) -> Row:
    """Reading, retargeting, certifying and writing in this process."""
    shutil.rmtree(out, ignore_errors=True)
    env = EnvConfig(expert=ArmConfig(model="panda"), learner=ArmConfig(model=str(learner)))
    began = time.perf_counter()
    keys = RetargetConfig(str(source), env=env, out=str(out), base=base, failing="kept", compilation_cache=str(cache))
    work = prepare_retargeting(keys)
    assert work() == 0
    seconds = time.perf_counter() - began
    episodes = json.loads((out / "report.json").read_text())["episodes"]
    frames = sum(episode["frames"] for episode in episodes)
    return {
        "episodes": len(episodes),
        "frames": frames,
        "exact": sum(episode["exact_frames"] for episode in episodes) / frames,
        "ok": np.mean([episode["ok"] for episode in episodes]),
        "seconds": seconds,
        "frames_per_s": frames / seconds,
    }


def row(options: argparse.Namespace, name: str) -> Row:
    work, demonstrations = Path(options.work).absolute(), Path(options.demonstrations)
    learner, out, cache = with_speeds(options.folder, name).absolute(), work / f"out_{name}", work / f"cache_{name}"
    write_episodes(work / "recordings.hdf5", demonstrations, 0)
    write_episodes(work / "episodes.hdf5", demonstrations, options.frames)
    of_command = command(work / "recordings.hdf5", learner, out, cache)
    for _ in range(2):  # the first time compiles
        timed = whole(work / "episodes.hdf5", learner, out, cache, of_command["base"])
    return as_numbers({"learner": name, **timed, "cores": os.cpu_count(), **of_command})


def main(arguments: list[str] | None = None) -> None:
    parser = make_parser(
        "transfer_throughput", __doc__, demonstrations="../shared/data/robosuite_demos", work="transfer_throughput",
        arms=("ur5e", "iiwa14", "xarm7"), frames=4000,
    )  # fmt: skip
    parser.add_argument("folder")
    options = parser.parse_args(arguments)
    Path(options.work).mkdir(parents=True, exist_ok=True)
    collect(options, (row(options, name) for name in options.arms), "rows", COLUMNS)


if __name__ == "__main__":
    main()
