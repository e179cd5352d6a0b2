"""`python -m mimic.retarget`: motions that keep the velocity limits of the learner, and what is rejected."""

import dataclasses
import json

import numpy as np
import pytest

import mimic
from mimic.commands import retarget
from mimic.commands.retargeted_motions import read_motions
from mimic.retargeting.certificate import Certificate
from mimic.retargeting.motions import largest_jump, retarget_motions
from tests.helpers.commands import run


@pytest.fixture(scope="module")
def recorded(tmp_path_factory):
    path = tmp_path_factory.mktemp("demonstrations") / "expert.npz"
    env = mimic.make("planar4dof", demonstrations={"count": 3, "held_out": 1})
    env.demonstrations.save(path)
    return path


@pytest.mark.slow
def test_demonstrations_become_those_of_the_learner(recorded, tmp_path):
    out = tmp_path / "learner"
    printed = run("retarget", f"source={recorded}", "env=planar4dof", "hand=scaled", f"out={out}")
    assert "episodes: 3 of 3 are written" in printed
    motions = mimic.load_demonstrations(out / recorded.name)
    env = mimic.make("planar4dof", demonstrations={"count": 1, "held_out": 1})
    motions.check_fits(env.learner, 0.1, 50)
    assert motions.count == 3 and motions.torque is None
    assert read_motions(out).base is None  # so that a video shows the expert in the learner's size


@pytest.mark.slow
def test_no_joint_moves_farther_in_a_step_than_its_velocity_limit_allows():
    """The expert's poses are random, so that the learner would jump at each step; the last joint's limit is unknown."""
    env, rng = mimic.env_config("planar4dof"), np.random.default_rng(0)
    expert, learner = (mimic.build_arm(arm).embodiment for arm in (env.expert, env.learner))
    learner = dataclasses.replace(learner, velocity_limit=np.array([0.5, 1.0, 2.0, np.inf]))
    largest, qpos = largest_jump(learner, 0.1), rng.uniform(-3, 3, (8, expert.num_joints))
    np.testing.assert_allclose(largest, [0.05, 0.1, 0.2, 0.1 * np.pi])
    (motion,) = retarget_motions(expert, learner, [qpos], env.metric, hand="scaled", largest_jump=largest)
    jumps = np.abs(np.diff(motion, axis=0))
    assert np.all(jumps <= largest + 1e-6)  # float32, of angles up to 6 rad
    assert np.all(jumps.max(axis=0) > largest - 1e-6)  # each joint reaches its bound


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["source={recorded}", "env=planar4dof", "out=new", "units=deg"], "joints, topic, units, rate: expected none"),
        (["source=none.csv", "hand=firm"], "hand: expected one of exact, near, scaled"),
        (["source=none.csv", "base=[1,2]"], "base: expected same, auto or [x,y,z,yaw], got [1, 2]"),
        (["source=none.csv", "failing=maybe"], "failing: expected one of left_out, kept"),
        (["source=none.csv", "out=new"], "source: no file at 'none.csv'"),
        (["source={clip}", "out=new"], "python -m mimic.demonstrations source="),
        (["source=certificate.npz", "out=new"], "source: expected another name than certificate.npz"),
        (["source=none.csv", "out=new", "costs.velocity=1"], "costs: expected no velocity or acceleration"),
        (["source=none.csv", "out=new", "hand=scaled", "base=auto"], "base: expected no auto with hand=scaled"),
        (["source={recorded}", "env=planar4dof"], "out: expected a folder"),
        (["source={recorded}", "learner=panda4dof", "out=new"], "got those of"),
        (["source={recorded}", "learner=pair", "out=new"], "learner: expected an arm, or an environment"),
        (["source={recorded}", "env=planar4dof", "out={recorded}"], "exists; name a new folder"),
    ],
)
def test_bad_input(reason, recorded, arguments, message):
    (clip := recorded.with_name("clip.bvh")).touch()
    assert message in reason("retarget", *(argument.format(recorded=recorded, clip=clip) for argument in arguments))


def test_bad_input_of_the_command(rejected):
    assert "expected a data set or a file of demonstrations" in rejected("retarget", "env=planar4dof")


@pytest.mark.slow
def test_a_data_set_of_one_arm_becomes_one_of_another(tmp_path):
    """The learner has the expert's links but other names: what is written are the expert's motions."""
    time = np.arange(0, 3, 0.05)
    qpos = 0.4 * np.sin(time[:, None] + np.arange(7)) + [0, 0.6, 0, -1.5, 0, 1.5, 0]  # axes 1 and 3 are never parallel
    rows = np.column_stack([time, qpos, np.linspace(0, 1, len(time))])
    header = ",".join(["time", *mimic.panda().joint_names, "gripper"])
    np.savetxt(tmp_path / "in.csv", rows, delimiter=",", header=header, comments="")
    out = tmp_path / "out"
    printed = run("retarget", f"source={tmp_path}/in.csv", "learner=panda", "hand=scaled", f"out={out}")
    assert "episodes: 1 of 1 are written" in printed
    assert "gripper, as in the source: gripper" in printed
    written = np.genfromtxt(out / "in.csv", delimiter=",", names=True)
    np.testing.assert_allclose(written["gripper"], rows[:, -1], atol=1e-9)
    report = json.loads((out / "report.json").read_text())
    assert report["episodes"][0]["written"]
    assert report["episodes"][0]["frames"] == len(time)
    assert (out / "certificate.png").stat().st_size > 10_000
    found = np.stack([written[name] for name in mimic.panda().joint_names[:6]], axis=1)
    np.testing.assert_allclose(found, qpos[:, :6], atol=1e-3)


@pytest.mark.parametrize(
    ("failing", "chosen"), [([5, 3, 0, 1], 2), ([5, 3, 4, 6], 1), ([0, 9, 9, 9], 0), ([90, 0, 0, 0], 0)]
)
def test_an_episode_of_which_few_frames_fail_is_searched_again(monkeypatch, failing, chosen):
    def of_seed(_, names, setting):
        for name in names:  # the second episode needs no search
            count = 0 if name == "easy" else failing[setting.seed]
            causes = ("hand out of reach",) * count + ("",) * (100 - count)
            none = np.zeros(100)
            yield setting.seed, Certificate(none, none, none, none, none, causes)

    monkeypatch.setattr(retarget, "_retarget_from", of_seed)
    setting = retarget._Setting(*[None] * 6, 0, *[None] * 5)  # type: ignore[arg-type]
    found = retarget.retarget_episodes(None, ["hard", "easy"], setting)  # type: ignore[arg-type]
    assert found["easy"][0] == 0
    seed, certificate = found["hard"]
    assert seed == chosen
    assert sum(map(bool, certificate.causes)) == failing[chosen]


def test_a_negative_clearance_is_explained():
    none, names = np.zeros(2), {"far": 0.03, "near": -0.0091, "nearer not": -0.004, "unknown": np.nan}
    certificates = {
        name: Certificate(none, none, none, none, np.array([0.1, value]), ("", ""), "the base and the link of b")
        for name, value in names.items()
    }
    (line,) = retarget._overlap_lines(certificates)
    assert line.startswith("clearance below 0: capsules around the base and the link of b overlap, by 9 mm in near; ")
    assert not retarget._overlap_lines({"far": certificates["far"], "unknown": certificates["unknown"]})


def test_advice_is_what_a_user_can_set():
    none = np.zeros(3)  # all hands are at their places: their rotations are wrong
    certificate = Certificate(none, none + 1, none, none, none, ("hand out of reach",) * 3)
    setting = retarget._Setting(*[None] * 6, 0, *[None] * 5)  # type: ignore[arg-type]
    line = retarget._help_line({"episode": certificate}, setting)
    assert line == "what would help: another base (base=auto); hand=near, which takes the nearest hand"
