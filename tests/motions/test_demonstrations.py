"""Demonstrations made of others: crossovers, and other lengths."""

import numpy as np
import pytest

import mimic
from mimic.motions.demonstrations import crossovers


def panda():
    return mimic.build_arm(mimic.ArmConfig())


@pytest.fixture(scope="module")
def recorded():
    return mimic.record_demonstrations(panda(), 2)


def test_crossovers_take_each_joint_from_one_demonstration():
    original = mimic.record_demonstrations(panda(), 3)
    mixed = crossovers(original, 20, seed=4)
    assert mixed.count == 20 and mixed.torque is None  # nobody knows what holds the mixture
    assert (mixed.arm, mixed.joint_names, mixed.dt) == (original.arm, original.joint_names, original.dt)
    sources = set()
    for which in range(mixed.count):
        chosen = []
        for joint in range(7):
            (source,) = np.flatnonzero((original.qpos[:, :, joint] == mixed.qpos[which, :, joint]).all(axis=1))
            np.testing.assert_array_equal(mixed.qvel[which, :, joint], original.qvel[source, :, joint])
            assert mixed.goals[which, joint] == original.goals[source, joint]
            chosen.append(int(source))
        sources.add(tuple(chosen))
    assert len(sources) > 15  # of 3^7 choices
    np.testing.assert_array_equal(crossovers(original, 20, seed=4).qpos, mixed.qpos)
    assert not np.array_equal(crossovers(original, 20, seed=5).qpos, mixed.qpos)


@pytest.mark.parametrize("steps", [30, 50, 55])
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
