"""Demonstrations: what files keep, which are rejected, and those made of others: crossovers, and other lengths."""

import dataclasses

import numpy as np
import pytest

import mimic
from mimic.envs.imitation import training_and_held_out
from mimic.motions.demonstrations import concatenate, crossovers


def panda():
    return mimic.build_arm(mimic.ArmConfig())


@pytest.fixture(scope="module")
def recorded():
    return mimic.record_demonstrations(panda(), 2)


def changed(demonstrations, key, value):
    """With one value of one joint changed: demonstration 1, sample 4, joint 3."""
    values = getattr(demonstrations, key).copy()
    values[1, 4, 2] = value
    return dataclasses.replace(demonstrations, **{key: values})


def test_files_keep_demonstrations_unchanged(recorded, tmp_path):
    bare = dataclasses.replace(recorded, torque=None)
    for demonstrations in (recorded, bare):
        demonstrations.save(tmp_path / "demonstrations.npz")
        loaded = mimic.load_demonstrations(tmp_path / "demonstrations.npz")
        for field in dataclasses.fields(mimic.Demonstrations):
            np.testing.assert_array_equal(getattr(loaded, field.name), getattr(demonstrations, field.name))


def test_torques_are_kept_where_all_have_them(recorded):
    bare = dataclasses.replace(recorded, torque=None)
    np.testing.assert_array_equal(recorded.select([1]).torque, recorded.torque[1:])
    assert bare.select([1]).torque is None
    np.testing.assert_array_equal(concatenate(recorded.select([0]), recorded.select([1])).torque, recorded.torque)
    assert concatenate(recorded, bare).torque is None and concatenate(bare, recorded).torque is None


# --- bad files --------------------------------------------------------------------------------------------------------


def arrays(path):
    with np.load(path) as archive:
        return dict(archive)


def with_arrays(**changes):
    return lambda path: np.savez(path, **{**arrays(path), **changes})


def without(name):
    return lambda path: np.savez(path, **{key: value for key, value in arrays(path).items() if key != name})


NOT_WHOLE = "is not a complete npz file of demonstrations: "
DAMAGES = {
    "missing": (lambda path: path.unlink(), "no file at"),
    "truncated": (lambda path: path.write_bytes(path.read_bytes()[:-1000]), NOT_WHOLE),
    "pickled array": (with_arrays(goals=np.array([{}, None], object)), NOT_WHOLE + "goals has type object"),
    "no velocities": (without("qvel"), "it lacks qvel; expected are "),
    "another format": (with_arrays(format=np.array("other")), "has format 'other', expected "),
    "integers": (with_arrays(qpos=np.zeros((2, 51, 7), int)), "qpos in .* must be floating point, got int64"),
    "angles not finite": (with_arrays(qpos=np.full((2, 51, 7), np.nan)), "qpos in .* has values that are not finite"),
    "a joint too few": (with_arrays(qpos=np.zeros((2, 51, 6))), r"qpos in .* 7 joints\], got \[2, 51, 6\]"),
    "a sample too few": (with_arrays(qvel=np.zeros((2, 50, 7))), "qvel and goals in .*, got "),
    "two seeds": (with_arrays(seed=np.arange(2)), "seed in .* must be one value, got shape"),
    "a broken seed": (with_arrays(seed=np.array(0.5)), "seed in .* must be an integer, got float64"),
    "time runs back": (with_arrays(dt=np.array(-1.0)), "dt in .* must be one number above 0, got -1.0"),
    "a torque too many": (with_arrays(torque=np.zeros((2, 51, 7))), r"torque in .* must be \[2, 50, 7\], got \[2, 51"),
}


@pytest.mark.parametrize("case", DAMAGES)
def test_damaged_files_are_rejected_in_one_line(recorded, tmp_path, case):
    damage, message = DAMAGES[case]
    path = tmp_path / "demonstrations.npz"
    recorded.save(path)
    damage(path)
    with pytest.raises(ValueError, match=f"^demonstrations: .*{message}") as error:
        mimic.load_demonstrations(path)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("name", ["motions.csv", "other.npz", "folder"])
def test_files_of_others_are_to_be_imported_first(tmp_path, name):
    (tmp_path / "motions.csv").write_text("time,joint1\n0,0\n")
    np.savez(tmp_path / "other.npz", qpos=np.zeros((3, 7)), joint_names=["a"], frequency=1.0)
    (tmp_path / "folder").mkdir()
    with pytest.raises(
        ValueError, match="mimic.demonstrations source=FILE out=NEW.npz imports motions of other formats"
    ):
        mimic.load_demonstrations(tmp_path / name)


@pytest.mark.parametrize(
    ("expert", "dt", "horizon", "message"),
    [
        (
            mimic.planar_arm([0.5, 0.5]),
            0.1,
            50,
            "expected .* with the joints joint1, joint2, got .* with joint1, ",
        ),
        (mimic.panda(locked=[7]), 0.1, 50, "expected .* 'panda-joint7' with .*, joint6, got those of 'panda' with"),
        (
            dataclasses.replace(mimic.panda(), name="other"),
            0.1,
            50,
            "expected motions of the expert 'other', got those of 'panda'; env.expert=ARM sets the expert",
        ),
        (mimic.panda(), 0.05, 50, r"expected a time step of 0.05 s \(env.control_dt\), got 0.1 s"),
        (mimic.panda(), 0.1, 51, r"expected 51 steps or more \(env.horizon\), got 50"),
    ],
)
def test_demonstrations_of_another_arm_time_step_or_length_are_rejected(recorded, expert, dt, horizon, message):
    recorded.check_fits(mimic.panda(), 0.1, 50)
    with pytest.raises(ValueError, match=f"^demonstrations: {message}"):
        recorded.check_fits(expert, dt, horizon)


def test_angles_torques_and_velocities_beyond_the_limits_are_rejected_and_rounding_passes(recorded):
    arm = panda().embodiment
    with pytest.raises(ValueError, match="has a torque of 87.1 N m at 0.4 s, but its torque limit is 87 N m"):
        mimic.check_effort(changed(recorded, "torque", 87.1), arm)
    bare = dataclasses.replace(recorded, torque=None)
    message = "joint3 of demonstration 1 has a velocity of -2.2 rad/s at 0.4 s, but its velocity limit is 2.175 rad/s"
    with pytest.raises(ValueError, match=message):
        mimic.check_effort(changed(bare, "qvel", -2.2), arm)
    at_limit = changed(changed(recorded, "qvel", np.float32(2.175)), "torque", -87.0)
    mimic.check_effort(at_limit, arm)
    joint_range = np.where(np.arange(7)[:, None] == 2, [-2.9, 2.9], arm.joint_range)
    narrow = dataclasses.replace(arm, joint_range=joint_range)
    message = "joint3 of demonstration 1 is at -3 rad at 0.4 s, but its range is -2.9 to 2.9 rad"
    with pytest.raises(ValueError, match=message):
        mimic.check_effort(changed(recorded, "qpos", -3.0), narrow)
    mimic.check_effort(changed(recorded, "qpos", -2.91), narrow)  # as far as the readers of recordings take
    mimic.check_effort(changed(recorded, "qpos", 9.0), arm)  # whose joints can rotate by a full revolution
    mimic.check_effort(changed(recorded, "torque", 1e6), dataclasses.replace(arm, torque_limit=np.full(7, np.inf)))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda recorded: dataclasses.replace(recorded, arm="other"), "got those of 'other'"),
        (lambda recorded: changed(recorded, "qvel", 3.0), "has a velocity of"),
        (lambda recorded: recorded.select([0]), r"has 1, expected at least count \+ held_out = 1 \+ 1$"),
    ],
    ids=["another arm", "too fast", "too few"],
)
def test_training_rejects_demonstrations_that_do_not_fit(recorded, tmp_path, change, message):
    path = tmp_path / "demonstrations.npz"
    change(recorded).save(path)
    config = mimic.env_config("panda4dof", demonstrations={"path": str(path), "count": 1, "held_out": 1})
    with pytest.raises(ValueError, match=message):
        training_and_held_out(config)


def test_too_few_demonstrations_can_be_trained_on_by_the_settings_that_are_named(recorded, tmp_path):
    recorded.save(tmp_path / "demonstrations.npz")
    settings = {"path": str(tmp_path / "demonstrations.npz")}
    message = r"as with env.demonstrations.count=1 env.demonstrations.held_out=1$"
    with pytest.raises(ValueError, match=message):
        training_and_held_out(mimic.env_config("panda7dof", demonstrations=settings))
    settings |= {"count": 1, "held_out": 1}
    training, held_out = training_and_held_out(mimic.env_config("panda7dof", demonstrations=settings))
    assert training.count == held_out.count == 1


def test_a_gripper_is_kept_with_the_motions(recorded, tmp_path):
    opening = np.random.default_rng(0).random((recorded.count, recorded.horizon + 1, 2))
    with_gripper = dataclasses.replace(recorded, gripper=opening, gripper_names=("left", "right"))
    with_gripper.save(tmp_path / "a.npz")
    loaded = mimic.load_demonstrations(tmp_path / "a.npz")
    np.testing.assert_array_equal(loaded.gripper, opening)
    assert loaded.gripper_names == ("left", "right")
    np.testing.assert_array_equal(loaded.select([1]).gripper, opening[[1]])
    np.testing.assert_array_equal(loaded.of_length(3).gripper, opening[:, :4])
    np.testing.assert_array_equal(concatenate(loaded, loaded).gripper, np.concatenate([opening, opening]))
    assert concatenate(loaded, recorded).gripper is None and crossovers(loaded, 2, 0).gripper_names == ()
    dataclasses.replace(with_gripper, gripper=opening[:, 1:]).save(tmp_path / "b.npz")
    with pytest.raises(ValueError, match="gripper in .* must be"):
        mimic.load_demonstrations(tmp_path / "b.npz")


# --- made of others ---------------------------------------------------------------------------------------------------


def test_crossovers_take_each_joint_from_one_demonstration():
    original = mimic.record_demonstrations(panda(), 3)
    mixed = crossovers(original, 40, seed=4)
    assert mixed.count == 40 and mixed.torque is None  # nobody knows what holds the mixture
    assert (mixed.arm, mixed.joint_names, mixed.dt) == (original.arm, original.joint_names, original.dt)
    sources = set()
    for which in np.flatnonzero(np.arange(mixed.count) % 4 < 3):
        chosen = []
        for joint in range(7):
            (source,) = np.flatnonzero((original.qpos[:, :, joint] == mixed.qpos[which, :, joint]).all(axis=1))
            np.testing.assert_array_equal(mixed.qvel[which, :, joint], original.qvel[source, :, joint])
            assert mixed.goals[which, joint] == original.goals[source, joint]
            chosen.append(int(source))
        sources.add(tuple(chosen))
    assert len(sources) > 20  # of 3^7 choices
    np.testing.assert_array_equal(crossovers(original, 40, seed=4).qpos, mixed.qpos)
    assert not np.array_equal(crossovers(original, 40, seed=5).qpos, mixed.qpos)


def test_every_fourth_crossover_is_smaller_and_some_of_its_joints_stay():
    original = mimic.record_demonstrations(panda(), 1)  # one parent: the whole crossovers are the original
    mixed = crossovers(original, 200, seed=4).select(slice(3, None, 4))
    displacement = original.qpos[0] - original.qpos[0, 0]
    size = (mixed.qpos - mixed.qpos[:, :1])[:, -1] / displacement[-1]
    stays = size == 0
    factor = size.max(axis=1)
    np.testing.assert_allclose(size, np.where(stays, 0, factor[:, None]), atol=1e-9)
    assert 0.2 < stays.mean() < 0.4 and factor.min() < 0.1 and 0.9 < factor.max() < 1
    np.testing.assert_allclose(mixed.qpos, original.qpos[0, 0] + size[:, None] * displacement, atol=1e-12)
    np.testing.assert_allclose(mixed.qvel, size[:, None] * original.qvel[0], atol=1e-12)
    ways = original.goals[0] - original.qpos[0, 0]
    np.testing.assert_allclose(mixed.goals, original.qpos[0, 0] + size * ways, atol=1e-12)


def test_a_fraction_of_the_crossovers_is_displaced_within_the_joint_range():
    original = mimic.record_demonstrations(panda(), 3)
    joint_range = np.tile([-2.5, 3.0], (7, 1))
    still, moved = (crossovers(original, 300, seed=4, displaced=x, joint_range=joint_range) for x in (0.0, 0.4))
    offset = moved.qpos - still.qpos
    np.testing.assert_allclose(offset, np.broadcast_to(offset[:, :1], offset.shape), atol=1e-12)
    np.testing.assert_allclose(moved.goals - still.goals, offset[:, 0], atol=1e-12)
    np.testing.assert_array_equal(moved.qvel, still.qvel)
    is_moved = np.any(offset != 0, axis=(1, 2))
    assert 0.3 < is_moved.mean() < 0.5 and np.all(offset[is_moved, 0] != 0)
    assert -2.5 <= moved.qpos.min() < -2.4 and 2.9 < moved.qpos.max() <= 3.0


@pytest.mark.parametrize("steps", [30, 55])
def test_another_length_cuts_or_repeats_the_last_sample(recorded, steps):
    other = recorded.of_length(steps)
    assert other.horizon == steps
    for key in ("qpos", "qvel"):
        samples, original = getattr(other, key), getattr(recorded, key)
        np.testing.assert_array_equal(samples[:, :51], original[:, : steps + 1])
        assert np.all(samples[:, 51:] == original[:, -1:])
    assert (other.torque is None) == (steps > 50)  # nobody knows what would hold it longer
    if other.torque is not None:
        np.testing.assert_array_equal(other.torque, recorded.torque[:, :steps])
