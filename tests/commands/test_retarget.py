"""`python -m mimic.retarget`: motions that keep the velocity limits of the learner, and what is rejected."""

import dataclasses
import json

import jax
import numpy as np
import pytest

import mimic
from mimic.commands import retarget_data
from mimic.commands.retarget import retarget
from mimic.retargeting.certificate import Certificate
from mimic.trainers.config import PoseMapperConfig
from mimic.trainers.pose_mapper.model import make_model
from tests.helpers.commands import run


@pytest.fixture(scope="module")
def recorded(tmp_path_factory):
    path = tmp_path_factory.mktemp("demonstrations") / "expert.npz"
    env = mimic.make("planar4dof", demonstrations={"count": 3, "held_out": 1})
    env.demonstrations.save(path)
    return path


@pytest.mark.slow
def test_the_motions_load_and_do_not_jump(recorded, tmp_path):
    out = tmp_path / "learner.npz"
    assert "maximum jump" in run("retarget", f"demonstrations={recorded}", "env=planar4dof", f"out={out}")
    motions = mimic.load_demonstrations(out)
    env = mimic.make("planar4dof", demonstrations={"count": 1, "held_out": 1})
    motions.check_fits(env.learner, 0.1, 50)
    assert motions.torque is None


@pytest.mark.slow
@pytest.mark.parametrize("with_mapper", [False, True], ids=["optimised", "mapped"])
def test_no_joint_moves_farther_in_a_step_than_its_velocity_limit_allows(with_mapper):
    """The expert's poses are random, so that the learner would jump at each step; the last joint's limit is unknown."""
    env, dt, rng = mimic.env_config("planar4dof"), 0.1, np.random.default_rng(0)
    expert, learner = (mimic.build_arm(arm).embodiment for arm in (env.expert, env.learner))
    learner = dataclasses.replace(learner, velocity_limit=np.array([0.5, 1.0, 2.0, np.inf]))
    qpos = rng.uniform(-3, 3, (2, 8, expert.num_joints))
    leaps = mimic.Demonstrations(qpos, 0 * qpos, qpos[:, -1], dt, expert.name, expert.joint_names)
    model = make_model(env, PoseMapperConfig(hidden_layers=[16]).resolve())
    mapper = mimic.PoseMapper(model, model.init(jax.random.key(0))) if with_mapper else None
    motions, report = retarget(leaps, expert, learner, env.metric, mapper=mapper)
    jumps, largest = np.abs(np.diff(motions.qpos, axis=1)), dt * np.array([0.5, 1.0, 2.0, np.pi])
    assert np.all(jumps <= largest + 1e-6)  # float32, of angles up to 6 rad
    assert np.all(jumps.max(axis=(0, 1)) > largest - 1e-6)  # each joint reaches its bound
    assert report["largest_jump"] == jumps.max()
    assert np.all(np.abs(motions.qvel) <= largest / dt)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["env=planar4dof"], "expected a data set or a file of demonstrations"),
        (["source=none.csv", "demonstrations={recorded}"], "source: expected neither demonstrations= nor mapper="),
        (["source=none.csv", "hand=firm"], "hand: expected one of exact, near, scaled"),
        (["source=none.csv", "base=[1,2]"], "base: expected same, auto or [x,y,z,yaw], got [1, 2]"),
        (["source=none.csv", "failing=maybe"], "failing: expected one of left_out, kept"),
        (["source=none.csv", "out=new"], "source: no file at 'none.csv'"),
        (["demonstrations={recorded}", "env=planar4dof"], "out: expected a file"),
        (["demonstrations={recorded}", "learner=panda4dof", "out=new.npz"], "recorded with the joints"),
        (
            ["demonstrations={recorded}", "learner=pair", "out=new.npz"],
            "learner: expected an arm, or an environment",
        ),
        (["demonstrations={recorded}", "env=planar4dof", "out={recorded}"], "exists; name a new file"),
        (["demonstrations={recorded}", "env=planar4dof", "out=new.npz", "mapper=."], "not a run directory"),
    ],
)
def test_bad_input(reason, recorded, arguments, message):
    assert message in reason("retarget", *(argument.format(recorded=recorded) for argument in arguments))


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

    monkeypatch.setattr(retarget_data, "_retarget_from", of_seed)
    setting = retarget_data._Setting(*[None] * 6, 0, *[None] * 5)  # type: ignore[arg-type]
    found = retarget_data.retarget_episodes(None, ["hard", "easy"], setting)  # type: ignore[arg-type]
    assert found["easy"][0] == 0
    seed, certificate = found["hard"]
    assert seed == chosen
    assert sum(map(bool, certificate.causes)) == failing[chosen]
