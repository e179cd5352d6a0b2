"""From a clip to demonstrations: `python -m mimic.demonstrations source=CLIP`, and the inspection of clips."""

import shlex

import numpy as np
import pytest

import mimic
from mimic.commands.capture import body_lines, prepare_capture_inspection, read_arm, read_body
from mimic.commands.config import CaptureConfig
from mimic.motions.mocap.clips import slow_down_for
from mimic.motions.mocap.link_motion import arm_motion
from tests.helpers.bodies import bvh_text, person, write_npz
from tests.helpers.commands import compose, run


def printed_words(text, label, command):
    """The arguments of each command that is printed behind a label."""
    starts = f"{label}: python -m mimic.{command} "
    return [shlex.split(line.removeprefix(starts)) for line in text.splitlines() if line.startswith(starts)]


@pytest.fixture(scope="module")
def clip(tmp_path_factory):
    """A short clip."""
    path = tmp_path_factory.mktemp("clips") / "clip.bvh"
    path.write_text(bvh_text(200))
    return path


@pytest.fixture(scope="module")
def long_clip(tmp_path_factory):
    path = tmp_path_factory.mktemp("clips") / "clip.bvh"
    path.write_text(bvh_text(900))
    return path


@pytest.fixture(scope="module")
def written(long_clip):
    """Demonstrations of the left arm, and what the command printed."""
    arguments = f"source={long_clip}", "arm=left", "out=left.npz", "env=panda7dof", "learner.locked=[7]"
    return long_clip.parent, run("demonstrations", *arguments, folder=long_clip.parent)


@pytest.mark.slow
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


@pytest.mark.slow
def test_demonstrations_of_both_arms_fit_the_bimanual_environment(long_clip):
    arguments, folder = (f"source={long_clip}", "arm=both", "out=both.npz", "env=bimanual"), long_clip.parent
    printed = run("demonstrations", *arguments, folder=folder)
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
    write_npz(tmp_path / "clip.npz", body.names, positions)
    capture = read_arm(tmp_path / "clip.npz", "right", CaptureConfig())
    assert [len(part.start) for part in capture.parts] == [300] and capture.starts == [0.0]
    capture = read_arm(tmp_path / "clip.npz", "left", CaptureConfig())
    assert [len(part.start) for part in capture.parts] == [100, 100]
    assert capture.starts == pytest.approx([0.0, 200 / body.rate]) and capture.bridged == 0
    positions[100:194] = body.positions[100:194]  # 0.1 s remain
    write_npz(tmp_path / "short.npz", body.names, positions)
    capture = read_arm(tmp_path / "short.npz", "left", CaptureConfig())
    assert [len(part.start) for part in capture.parts] == [300] and capture.bridged == 1


@pytest.mark.slow
def test_the_printed_command_trains_the_same_learner_on_the_clip(written, monkeypatch):
    folder, printed = written
    monkeypatch.chdir(folder)
    (words,) = printed_words(printed, "train on it", "train")
    env, demonstrations = compose("train", *words).env, mimic.load_demonstrations(folder / "left.npz")
    assert env.learner == mimic.env_config("panda7dof", learner={"locked": [7]}).learner
    expert, learner = env.build_arms().embodiments
    demonstrations.check_fits(expert, env.control_dt, env.horizon)
    assert learner.num_joints == 6 and env.demonstrations.path == "left.npz"
    assert env.demonstrations.count + env.demonstrations.held_out == demonstrations.count


def test_inspect_shows_what_a_clip_has(clip, tmp_path):
    printed = run("inspect", clip, folder=tmp_path)
    for part in ("unit: cm", "up: y", "left arm: LeftArm - LeftForeArm - LeftHand - LeftHandMiddle1"):
        assert part in printed
    commands = [
        compose("demonstrations", *words) for words in printed_words(printed, "demonstrations", "demonstrations")
    ]
    assert [(config.source, config.arm, config.out) for config in commands] == [
        (str(clip), arm, f"clip_{arm}.npz") for arm in ("left", "right", "both")
    ]
    assert commands[-1].env == mimic.env_config("bimanual")


def test_what_a_clip_lacks_is_said_of_its_own_key(tmp_path):
    (tmp_path / "clip.bvh").write_text("")
    with pytest.raises(ValueError, match=", got 'source:'$"):  # what the user wrote is not changed
        prepare_capture_inspection(tmp_path / "clip.bvh", CaptureConfig(unit="source:"))


def test_what_is_unusual_about_arms_is_named(tmp_path):
    body = person(60)
    positions = body.positions.copy()
    hand, elbow = (positions[:, body.names.index(name)] for name in ("RightHand", "RightForeArm"))
    hand[:] = elbow + 0.4 * (hand - elbow)
    write_npz(tmp_path / "clip.npz", body.names, positions, unit=np.array("m"))
    lines = body_lines(read_body(tmp_path / "clip.npz", CaptureConfig()))
    assert any(line.startswith("right arm: an upper arm of 0.28 m and a forearm of 0.10 m") for line in lines)
    assert any(line.startswith("arms of 0.53 m (left) and 0.38 m (right)") for line in lines)
    named = CaptureConfig(shoulder="RightArm", elbow="RightForeArm", wrist="RightHand+RightHandMiddle1")
    assert "right arm: RightArm - RightForeArm - RightHand+RightHandMiddle1" in " ".join(
        body_lines(read_body(tmp_path / "clip.npz", named))
    )


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("arm=middle",), "arm: expected left, right or both"),
        (("capture.unit=mile",), "unit"),
        (("count=3",), "count: expected none with source=FILE"),
        (("env.horizon=9000",), "expected a motion without gaps of"),
        (("capture.overlap=1",), "capture.overlap"),
        (("capture.subject=Bob",), "subject: expected one of 'Hips', got 'Bob'"),
        (("capture.wrist=p9",), "point: expected one of Hips"),
        (("arm=both", "capture.wrist=RightHand"), "expected with arm=left or arm=right, got arm=both"),
    ],
)
def test_bad_input_is_one_line(reason, clip, arguments, message):
    assert message in reason("demonstrations", f"source={clip}", "out=a.npz", *arguments)


def test_the_line_of_an_inspection_names_its_key(reason):
    assert reason("inspect", "clip=no.bvh").startswith("clip: no file at 'no.bvh'")


def test_the_model_of_the_arm_is_not_overwritten(reason, clip, tmp_path):
    (tmp_path / "a.xml").write_text("mine")
    assert "a.xml' exists" in reason("demonstrations", f"source={clip}", f"out={tmp_path}/a.npz")
    assert (tmp_path / "a.xml").read_text() == "mine"


def test_points_of_a_person_without_an_arm_are_a_question(reason, tmp_path):
    body = person(20)
    write_npz(tmp_path / "points.npz", body.names, body.positions)
    assert "expected arm=left, right or both" in reason(
        "demonstrations", f"source={tmp_path}/points.npz", "out=new.npz"
    )
