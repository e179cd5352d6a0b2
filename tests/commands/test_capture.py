"""From a clip to demonstrations: `python -m mimic.demonstrations source=CLIP`, and the inspection of clips."""

import shlex
import subprocess
import sys

import numpy as np
import pytest

import mimic
from mimic.commands.capture import read_arm
from mimic.commands.config import CaptureConfig
from mimic.motions.mocap.clips import slow_down_for
from mimic.motions.mocap.link_motion import arm_motion
from tests.helpers.bodies import bvh_text, person


def run(tmp_path, command, *arguments):
    return subprocess.run(
        [sys.executable, "-m", f"mimic.{command}", *arguments], capture_output=True, text=True, cwd=tmp_path
    )


@pytest.fixture(scope="module")
def clip(tmp_path_factory):
    path = tmp_path_factory.mktemp("clips") / "clip.bvh"
    path.write_text(bvh_text(900))
    return path


@pytest.fixture(scope="module")
def written(clip):
    """Demonstrations of the left arm, and what the command printed."""
    done = run(clip.parent, "demonstrations", f"source={clip}", "arm=left", "out=left.npz", "env=panda7dof")
    assert done.returncode == 0, done.stderr
    return clip.parent, done.stdout


def test_demonstrations_fit_the_arm_that_is_written_with_them(written):
    folder, printed = written
    demonstrations = mimic.load_demonstrations(folder / "left.npz")
    arm = mimic.load_mjcf(folder / "left.xml")
    demonstrations.check_fits(arm, 0.1, 50)
    assert arm.link_names == ("link_trunk", "link_upper_arm", "link_forearm", "link_hand")
    panda = mimic.panda()
    column = 0.333 / float(panda.chain_length)  # the Panda's fixed links; the same fraction is the person's trunk
    assert arm.link_lengths[0] / arm.chain_length == pytest.approx(column, rel=1e-3)
    slow_down = slow_down_for([arm_motion(person(900), "left")], 2.0)
    assert f"time: {slow_down:.2f} times as long" in printed
    assert (folder / "left.png").stat().st_size > 10_000


@pytest.fixture(scope="module")
def both(clip):
    """Demonstrations of both arms, and what the command printed."""
    done = run(clip.parent, "demonstrations", f"source={clip}", "arm=both", "out=both.npz", "env=bimanual")
    assert done.returncode == 0, done.stderr
    return clip.parent, done.stdout


@pytest.mark.slow
def test_demonstrations_of_both_arms_fit_the_bimanual_environment(both):
    folder, printed = both
    env = mimic.env_config("bimanual", expert={"model": str(folder / "both.xml")})
    expert, learner = env.build_arms().embodiments
    mimic.load_demonstrations(folder / "both.npz").check_fits(expert, 0.1, 50)
    assert expert.chain_names == ("left_hand", "right_hand") and learner.chain_names == ("left_body7", "right_body7")
    matrix = np.asarray(env.metric.build(expert, learner).correspondence)
    assert np.all(matrix[:4, 7:] == 0) and np.all(matrix[4:, :7] == 0)  # left to left
    assert matrix[0, 0] > 0 and matrix[7, 13] > 0
    assert expert.link_lengths[0] / expert.chain_length == pytest.approx(0.333 / learner.chain_length, rel=1e-3)
    assert "env=bimanual env.expert.model=" in printed


def test_a_gap_in_the_other_arm_splits_nothing(tmp_path):
    body = person(300)
    positions = body.positions.copy()
    positions[100:200, body.names.index("LeftHand")] = np.nan
    np.savez(tmp_path / "clip.npz", names=np.array(body.names), positions=positions, rate=body.rate)
    capture = read_arm(tmp_path / "clip.npz", "right", CaptureConfig())
    assert [len(part.start) for part in capture.parts] == [300] and capture.starts == [0.0]
    capture = read_arm(tmp_path / "clip.npz", "left", CaptureConfig())
    assert [len(part.start) for part in capture.parts] == [100, 100]
    assert capture.starts == pytest.approx([0.0, 200 / body.rate]) and capture.bridged == 0
    positions[100:194] = body.positions[100:194]  # 0.1 s remain
    np.savez(tmp_path / "short.npz", names=np.array(body.names), positions=positions, rate=body.rate)
    capture = read_arm(tmp_path / "short.npz", "left", CaptureConfig())
    assert [len(part.start) for part in capture.parts] == [300] and capture.bridged == 1


@pytest.mark.slow
@pytest.mark.parametrize("arms", ["written", "both"])
def test_the_printed_command_trains(request, arms):
    folder, printed = request.getfixturevalue(arms)
    command = next(line for line in printed.splitlines() if line.startswith("train on it: "))
    arguments = shlex.split(command.removeprefix("train on it: python -m mimic.train "))
    small = ["trainer.num_timesteps=4096", "trainer.num_envs=16", "trainer.batch_size=16", "trainer.evaluations=1"]
    done = run(folder, "train", *arguments, *small, "env.physics=fused", f"run_dir={arms}")
    assert done.returncode == 0, done.stderr
    assert (folder / arms / "report.json").is_file()


def test_inspect_shows_what_a_clip_has(clip, tmp_path):
    done = run(tmp_path, "inspect", str(clip), "out=pictures")
    assert done.returncode == 0, done.stderr
    for part in ("unit: cm", "up: y", "left arm: LeftArm - LeftForeArm - LeftHand - LeftHandMiddle1", "arm=right"):
        assert part in done.stdout
    assert (tmp_path / "pictures" / "skeleton.png").stat().st_size > 10_000


@pytest.mark.slow_for(
    "arguments0-arm: expected left, right or both",
    "arguments1-unit",
    "arguments2-count: expected none with source=FILE",
    "arguments3-expected a motion without gaps of",
)
@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("arm=middle",), "arm: expected left, right or both"),
        (("capture.unit=mile",), "unit"),
        (("count=3",), "count: expected none with source=FILE"),
        (("env.horizon=9000",), "expected a motion without gaps of"),
        (("capture.overlap=1",), "capture.overlap"),
    ],
)
def test_bad_input_is_one_line(clip, tmp_path, arguments, message):
    done = run(tmp_path, "demonstrations", f"source={clip}", "out=a.npz", *arguments)
    assert done.returncode == 2 and message in done.stderr and done.stderr.count("\n") == 1
    assert list(tmp_path.iterdir()) == []


@pytest.mark.slow
def test_nothing_is_overwritten(clip, tmp_path):
    (tmp_path / "a.xml").write_text("mine")
    done = run(tmp_path, "demonstrations", f"source={clip}", "out=a.npz")
    assert done.returncode == 2 and "a.xml" in done.stderr
    assert (tmp_path / "a.xml").read_text() == "mine"
    assert np.array([path.name for path in tmp_path.iterdir()]).tolist() == ["a.xml"]
