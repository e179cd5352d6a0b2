"""Demonstrations with what they take of the arm: `python -m mimic.demonstrations`, the file, and what is refused."""

import dataclasses
import subprocess
import sys

import mujoco
import numpy as np
import pytest

import mimic
from mimic.commands.config import RecordingConfig
from mimic.commands.demonstrations import prepare_recording
from mimic.commands.retarget import retarget
from mimic.envs.demonstrations import concatenate, crossovers
from mimic.envs.recording import KINDS

DT, SUBSTEPS = 0.1, 10
TRAIN = ["env=panda4dof", "env.demonstrations.count=1", "env.demonstrations.held_out=1"]


def panda():
    return mimic.build_arm(mimic.ArmConfig())


@pytest.fixture(scope="module")
def recorded():
    return mimic.record_demonstrations(panda(), 2)


@pytest.mark.parametrize("kind", ["pd", pytest.param("reach", marks=pytest.mark.slow)])
def test_the_command_records_what_the_library_does(kind, tmp_path):
    out = tmp_path / "demonstrations.npz"
    command = [sys.executable, "-m", "mimic.demonstrations", f"kind={kind}", "count=3", "seed=5", f"out={out}"]
    result = subprocess.run(command, capture_output=True, text=True, timeout=280, check=False)
    assert result.returncode == 0, result.stderr[-2000:]
    assert "all stay within the torque limits and velocity limits of panda" in result.stdout
    assert result.stdout.endswith(f"results: {out}\n")
    assert {path.name for path in tmp_path.iterdir()} == {"demonstrations.npz", "demonstrations.png"}
    loaded, expected = mimic.load_demonstrations(out), mimic.record_demonstrations(panda(), 3, kind=kind, seed=5)
    for field in dataclasses.fields(mimic.Demonstrations):
        np.testing.assert_array_equal(getattr(loaded, field.name), getattr(expected, field.name))


@pytest.mark.parametrize("kind", KINDS)
def test_the_torques_of_a_file_make_its_motion(kind, tmp_path):
    """1e-9 rad: the same double precision, on another run of the simulator."""
    mimic.record_demonstrations(panda(), 2, kind=kind).save(tmp_path / "demonstrations.npz")
    loaded = mimic.load_demonstrations(tmp_path / "demonstrations.npz")
    assert loaded.torque is not None and loaded.torque.shape == (2, 50, 7)
    model = panda().model
    model.opt.timestep = loaded.dt / SUBSTEPS
    for qpos, qvel, torque in zip(loaded.qpos, loaded.qvel, loaded.torque, strict=True):
        data = mujoco.MjData(model)
        data.qpos[:], data.qvel[:] = qpos[0], qvel[0]
        for held, expected_qpos, expected_qvel in zip(torque, qpos[1:], qvel[1:], strict=True):
            data.qfrc_applied[:] = held
            mujoco.mj_step(model, data, SUBSTEPS)
            np.testing.assert_allclose(data.qpos, expected_qpos, rtol=0, atol=1e-9)
            np.testing.assert_allclose(data.qvel, expected_qvel, rtol=0, atol=1e-8)  # rad/s, over a step of 0.1 s


def test_torques_are_kept_where_all_have_them(recorded, tmp_path):
    bare = dataclasses.replace(recorded, torque=None)
    for demonstrations in (recorded, bare):
        demonstrations.save(tmp_path / "demonstrations.npz")
        loaded = mimic.load_demonstrations(tmp_path / "demonstrations.npz")
        np.testing.assert_array_equal(loaded.torque, demonstrations.torque)
    np.testing.assert_array_equal(recorded.select([1]).torque, recorded.torque[1:])
    assert bare.select([1]).torque is None
    np.testing.assert_array_equal(concatenate(recorded.select([0]), recorded.select([1])).torque, recorded.torque)
    assert concatenate(recorded, bare).torque is None and concatenate(bare, recorded).torque is None


def test_crossovers_move_each_joint_as_a_given_one_does():
    given = mimic.record_demonstrations(panda(), 3)
    mixed = crossovers(given, 20, seed=4)
    assert mixed.count == 20 and mixed.torque is None  # nobody knows what holds the mixture
    assert (mixed.arm, mixed.joint_names, mixed.dt) == (given.arm, given.joint_names, given.dt)
    sources = set()
    for which in range(mixed.count):
        chosen = []
        for joint in range(7):
            (source,) = np.flatnonzero((given.qpos[:, :, joint] == mixed.qpos[which, :, joint]).all(axis=1))
            np.testing.assert_array_equal(mixed.qvel[which, :, joint], given.qvel[source, :, joint])
            assert mixed.goals[which, joint] == given.goals[source, joint]
            chosen.append(int(source))
        sources.add(tuple(chosen))
    assert len(sources) > 15  # of 3^7 choices
    np.testing.assert_array_equal(crossovers(given, 20, seed=4).qpos, mixed.qpos)
    assert not np.array_equal(crossovers(given, 20, seed=5).qpos, mixed.qpos)


@pytest.mark.parametrize("steps", [30, 50, 55])
def test_another_length_cuts_or_repeats_the_last_sample(recorded, steps):
    other = recorded.of_length(steps)
    assert other.horizon == steps
    for key in ("qpos", "qvel"):
        samples, given = getattr(other, key), getattr(recorded, key)
        np.testing.assert_array_equal(samples[:, :51], given[:, : steps + 1])
        assert np.all(samples[:, 51:] == given[:, -1:])
    assert (other.torque is None) == (steps > 50)  # nobody knows what would hold it longer
    if other.torque is not None:
        np.testing.assert_array_equal(other.torque, recorded.torque[:, :steps])


def test_a_recording_counts_the_goals_that_it_drew_anew():
    """Below the peak speeds of PD control, some goals must be turned down."""
    arm = panda()
    slow = dataclasses.replace(arm, embodiment=dataclasses.replace(arm.embodiment, velocity_limit=np.full(7, 1.0)))
    redrawn = []
    recorded = mimic.record_demonstrations(slow, 4, on_recorded=redrawn.append)
    assert len(redrawn) == 4 and sum(redrawn) > 0
    assert np.abs(recorded.qvel).max() <= 1.0
    mimic.check_effort(recorded, slow.embodiment)


def test_what_diverges_is_no_demonstration(tmp_path, monkeypatch):
    """Steps of 0.4 s blow up within one control step; MuJoCo would set the arm back to rest, which breaks no limit."""
    monkeypatch.chdir(tmp_path)  # MuJoCo writes a log of what diverges
    arm = panda()
    unlimited = dataclasses.replace(arm.embodiment, velocity_limit=np.full(7, np.inf))
    with pytest.raises(ValueError, match="exceed its limits"):
        mimic.record_demonstrations(dataclasses.replace(arm, embodiment=unlimited), 1, dt=2.0)


def raised(demonstrations, key, value):
    """With one value of one joint changed: demonstration 1, sample 4, joint 3."""
    changed = getattr(demonstrations, key).copy()
    changed[1, 4, 2] = value
    return dataclasses.replace(demonstrations, **{key: changed})


@pytest.mark.parametrize(
    ("key", "value", "message"),
    [
        ("torque", 87.1, "has a torque of 87.1 N m at 0.4 s, but its torque limit is 87 N m"),
        ("qvel", -2.2, "has a velocity of -2.2 rad/s at 0.4 s, but its velocity limit is 2.175 rad/s"),
    ],
)
def test_training_refuses_what_the_expert_cannot_do(recorded, refused, tmp_path, key, value, message):
    path = tmp_path / "beyond.npz"
    raised(recorded, key, value).save(path)
    assert f"joint3 of demonstration 1 {message}" in refused("train", *TRAIN, f"env.demonstrations.path={path}")


def test_speeds_are_checked_without_torques_and_rounding_is_let_pass(recorded):
    arm = panda().embodiment
    bare = dataclasses.replace(recorded, torque=None)
    with pytest.raises(ValueError, match="has a velocity of"):
        mimic.check_effort(raised(bare, "qvel", 3.0), arm)
    at_limit = raised(raised(recorded, "qvel", np.float32(2.175)), "torque", -87.0)
    mimic.check_effort(at_limit, arm)
    mimic.check_effort(raised(recorded, "torque", 1e6), dataclasses.replace(arm, torque_limit=np.full(7, np.inf)))


def test_retargeted_motions_have_no_torques_and_keep_the_rated_speeds():
    """Reaches ask joints for more than the rated speed, so that some retargeted jumps are at their bound."""
    config = mimic.env_config("panda4dof")
    expert, learner = (mimic.build_arm(arm).embodiment for arm in (config.expert, config.learner))
    reaches = mimic.record_demonstrations(panda(), 2, kind="reach", horizon=20)
    motions, _ = retarget(reaches, expert, learner, config.metric)
    assert motions.torque is None
    share = np.abs(motions.qvel) / learner.velocity_limit
    assert 0.999 < share.max() <= 1


@pytest.mark.parametrize(
    ("torque", "message"),
    [
        (np.zeros((2, 51, 7)), "torque in .* must be \\[2, 50, 7\\], got \\[2, 51, 7\\]"),
        (np.full((2, 50, 7), np.inf), "torque in .* has values that are not finite"),
        (np.zeros((2, 50, 7), int), "torque in .* must be floating point, got int64"),
    ],
)
def test_torques_that_are_none_are_refused(recorded, tmp_path, torque, message):
    path = tmp_path / "bad.npz"
    dataclasses.replace(recorded, torque=torque).save(path)
    with pytest.raises(ValueError, match=message):
        mimic.load_demonstrations(path)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ([], "out: expected a file"),
        (["out={taken}"], "exists; name a new file"),
        (["out=new.npz", "plot={taken}"], "exists; name a new file"),
        (["out=no/new.npz"], "there is no folder 'no'"),
        (["out=new.txt"], "expected a file that ends in .npz"),
        (["out=new.npz", "plot=new.txt"], "expected a file that ends in .png, .pdf, .svg"),
        (["out=new.npz", "kind=dance"], "expected one of pd, reach, got 'dance'"),
        (["out=new.npz", "count=0"], "at least 1, got 0"),
        (["out=new.npz", "seed=-1"], "expected at least 0, got -1"),
        (["out=new.npz", "limits=soft"], "expected one of none, hardware"),
        (["out=new.npz", "env=panda5dof"], "unknown env 'panda5dof'"),
        (["out=new.npz", "cuont=3"], "unknown key 'cuont'"),
    ],
)
def test_bad_input_of_the_command(refused, tmp_path, arguments, message):
    taken = tmp_path / "taken.npz"
    taken.write_text("")
    assert message in refused("demonstrations", *(argument.format(taken=taken) for argument in arguments))


def test_no_goal_within_the_limits_is_the_users_to_mend(tmp_path):
    config = mimic.env_config("planar4dof", control_dt=0.9)
    with pytest.raises(ValueError, match="exceed its limits"):
        prepare_recording(RecordingConfig(config, count=1, out=str(tmp_path / "new.npz")))
