"""Frames and points of an arm by matrices: the same by NumPy, by JAX and by `forward_kinematics`."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mimic.arms.arm import ArmConfig, build_arm
from mimic.control.clearance import joint_frames, moved_points
from mimic.metric.kinematics import forward_kinematics
from mimic.metric.matrix_kinematics import frame_constants, point_columns

CONFIGS = {"panda": ArmConfig(), "locked": ArmConfig(locked=[3, 6, 7]), "two arms": ArmConfig(model="panda_pair")}
TOLERANCE = 1e-5  # of float32: lengths of 1, and velocities of 5 rad/s


def states(arm, count=200, seed=0):
    rng, (lower, upper) = np.random.default_rng(seed), np.asarray(arm.joint_range).T
    qpos = rng.uniform(lower, upper, (count, arm.num_joints))
    return jnp.asarray(qpos, jnp.float32), jnp.asarray(rng.normal(size=qpos.shape), jnp.float32)


@pytest.mark.slow_for("panda", "locked")
@pytest.mark.parametrize("config", CONFIGS.values(), ids=CONFIGS)
def test_numpy_and_jax_have_the_same_frames(config):
    arm = build_arm(config, "hardware").embodiment
    qpos, constants = states(arm)[0], frame_constants(arm)
    moved, fixed = point_columns(arm, arm.link_joint, np.c_[arm.link_position, np.ones(arm.num_links)])
    frames = joint_frames(np.asarray(qpos), constants, np)
    np.testing.assert_allclose(jax.vmap(lambda q: joint_frames(q, constants, jnp))(qpos), frames, atol=TOLERANCE)
    expected = jax.vmap(lambda q: forward_kinematics(arm, q).position)(qpos)
    np.testing.assert_allclose(moved_points(frames, moved, fixed).transpose(0, 2, 1), expected, atol=TOLERANCE)
