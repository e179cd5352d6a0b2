"""Recorded demonstrations: simulated, within the limits of the expert, and reproducible."""

import dataclasses

import jax
import mujoco
import numpy as np
import pytest

import mimic
from mimic.arms.arm import ArmConfig, build_arm
from mimic.envs.imitation import recorded_demonstrations
from mimic.motions.demonstrations import effective_rank
from mimic.motions.experts import KINDS, make_expert

SUBSTEPS = 10  # of MuJoCo, a control step


def test_demonstrations_are_reproducible_and_within_limits():
    arm = build_arm(ArmConfig(), "hardware")
    few, more = (mimic.record_demonstrations(arm, count, seed=3) for count in (2, 3))
    np.testing.assert_array_equal(few.qpos, more.qpos[:2])
    lower, upper = arm.embodiment.joint_range.T
    assert np.all((more.qpos >= lower) & (more.qpos <= upper))
    assert np.all(np.abs(more.qvel) <= arm.embodiment.velocity_limit)
    assert np.all(more.qvel[:, 0] == 0)


@pytest.mark.parametrize("limits", ["none", "hardware"])
def test_reaches_end_where_they_should_and_within_limits(limits):
    arm = build_arm(ArmConfig(), limits)
    reaches = mimic.record_demonstrations(arm, 4, kind="reach", seed=1)
    embodiment = arm.embodiment
    assert np.all(np.abs(reaches.qvel) <= embodiment.velocity_limit)
    hand = jax.vmap(lambda qpos: mimic.forward_kinematics(embodiment, qpos).position[-1])
    np.testing.assert_allclose(hand(reaches.qpos[:, -1]), hand(reaches.goals), atol=5e-3)  # 5 mm: feedback, not fit
    other = mimic.record_demonstrations(arm, 4, kind="computed_torque", seed=1)
    assert not np.allclose(other.qpos, reaches.qpos, atol=0.1)


@pytest.mark.parametrize("limits", ["none", "hardware"])
def test_every_kind_stays_within_the_limits_of_the_manufacturer(limits):
    """Limits of acceleration: Franka Robotics' documentation of the Panda, for the mean of a control step."""
    config = mimic.env_config("panda7dof", limits=limits)
    expert = config.build_arms().expert
    recorded = recorded_demonstrations(config, expert, 2 * len(KINDS))
    assert recorded.kinds == KINDS * 2
    mimic.check_effort(recorded, expert.embodiment)
    lower, upper = expert.embodiment.joint_range.T
    assert np.all((recorded.qpos >= lower) & (recorded.qpos <= upper))
    acceleration = np.abs(np.diff(recorded.qvel, axis=1)) / recorded.dt
    assert np.all(acceleration <= np.array([15.0, 7.5, 10.0, 12.5, 15.0, 20.0, 20.0]) + 1e-9)


def test_the_test_set_is_another_one_than_any_seed_gives():
    config = mimic.env_config("planar4dof")
    expert = config.build_arms().expert
    unseen = recorded_demonstrations(config, expert, 5, kind="computed_torque", test=True)
    for seed in range(3):
        seen = mimic.record_demonstrations(expert, 5, kind="computed_torque", seed=seed)
        assert np.abs(unseen.goals[:, None] - seen.goals).max(axis=2).min() > 1e-3


def test_only_some_kinds_have_one_course_of_time():
    """1 is one course of time for all goals; splines and steps have several, each in its own time."""
    rank = {kind: effective_rank(mimic.record_demonstrations(panda(), 10, kind=kind)) for kind in KINDS}
    assert rank["computed_torque"] == pytest.approx(1.0, abs=0.01)
    assert rank["splines"] > 1.5 and rank["steps"] > 1.5


def test_a_pid_expert_has_no_model():
    """A joint alone, at rest and far from its goal, is pushed towards it in proportion to the error."""
    expert = make_expert("pid", panda(), np.random.default_rng(0), 50, 0.1)

    def no_model(acceleration):
        raise AssertionError("a PID controller has no inverse dynamics")

    zero = np.zeros(7)
    torque = expert.law(0, zero, zero, no_model)
    np.testing.assert_array_equal(np.sign(torque), np.sign(expert.goal))
    # The integral grows with each step at the same error; the rest of the law is the same.
    growth = [expert.law(step, zero, zero, no_model) - torque for step in (1, 2)]
    np.testing.assert_allclose(growth[1], 2 * growth[0], rtol=1e-9)


def panda():
    return mimic.build_arm(mimic.ArmConfig())


@pytest.mark.parametrize("kind", KINDS)
def test_recorded_torques_reproduce_the_motion(kind, tmp_path):
    """1e-9 rad: double precision, in another run of the simulator."""
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


def test_a_recording_counts_redrawn_goals():
    """Velocity limits below the peaks of the experts make it reject some goals."""
    arm = panda()
    slow = dataclasses.replace(arm, embodiment=dataclasses.replace(arm.embodiment, velocity_limit=np.full(7, 1.0)))
    redrawn = []
    recorded = mimic.record_demonstrations(slow, 4, on_recorded=redrawn.append)
    assert len(redrawn) == 4 and sum(redrawn) > 0
    assert np.abs(recorded.qvel).max() <= 1.0
    mimic.check_effort(recorded, slow.embodiment)


def test_a_diverging_simulation_is_rejected(tmp_path, monkeypatch):
    """Steps of 0.4 s diverge; MuJoCo would reset the arm to rest, which breaks no limit."""
    monkeypatch.chdir(tmp_path)  # MuJoCo writes a log of what diverges
    arm = panda()
    unlimited = dataclasses.replace(arm.embodiment, velocity_limit=np.full(7, np.inf))
    with pytest.raises(ValueError, match="exceed its limits"):
        mimic.record_demonstrations(dataclasses.replace(arm, embodiment=unlimited), 1, dt=2.0)


def test_an_embodiment_has_no_dynamics_to_record():
    with pytest.raises(ValueError, match=r"arm: expected an Arm, as of build_arm\(ArmConfig\(\)\), got Embodiment"):
        mimic.record_demonstrations(mimic.panda(), 1)
