"""Link states by matrices: those of `link_states`, by JAX and by ONNX; frames by NumPy and JAX."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mimic.arms.arm import ArmConfig, build_arm
from mimic.control.clearance import joint_frames, moved_points
from mimic.deploy.policy import open_session
from mimic.metric.kinematics import forward_kinematics, link_states
from mimic.metric.matrix_kinematics import frame_constants, make_link_vector, point_columns
from mimic.trainers.export.onnx_model import to_onnx

onnx = pytest.importorskip("onnx")
CONFIGS = {"panda": ArmConfig(), "locked": ArmConfig(locked=[3, 6, 7]), "two arms": ArmConfig(model="panda_pair")}
TOLERANCE = 1e-5  # of float32: lengths of 1, and velocities of 5 rad/s


def states(arm, count=200, seed=0):
    rng, (lower, upper) = np.random.default_rng(seed), np.asarray(arm.joint_range).T
    qpos = rng.uniform(lower, upper, (count, arm.num_joints))
    return jnp.asarray(qpos, jnp.float32), jnp.asarray(rng.normal(size=qpos.shape), jnp.float32)


@pytest.mark.slow_for("panda", "locked")
@pytest.mark.parametrize("config", CONFIGS.values(), ids=CONFIGS)
def test_they_are_the_link_states(config):
    arm = build_arm(config, "hardware").embodiment
    qpos, qvel = states(arm)

    def scalar(qpos, qvel):
        return jnp.concatenate([leaf.ravel() for leaf in jax.tree.leaves(link_states(arm, qpos, qvel))])

    link_vector = make_link_vector(arm)
    expected, result = (np.asarray(jax.vmap(function)(qpos, qvel)) for function in (scalar, link_vector))
    np.testing.assert_allclose(result, expected, atol=TOLERANCE)
    # A policy's statistics magnify what does not move a million times.
    constant = np.ptp(expected, axis=0) == 0
    assert constant.any()
    np.testing.assert_array_equal(result[:, constant], expected[:, constant])
    inputs: dict[str, int] = dict.fromkeys(("qpos", "qvel"), arm.num_joints)
    model = to_onnx(lambda *x: {"states": link_vector(*x)}, name="states", inputs=inputs)
    nodes = onnx.load_from_string(model).graph.node
    assert len(nodes) < 28 + 2 * arm.num_joints  # scalar arithmetic has 70 for each joint
    session = open_session(model, inputs, {"states": expected.shape[1]})
    (output,) = session.run(None, {"qpos": np.asarray(qpos), "qvel": np.asarray(qvel)})
    np.testing.assert_allclose(output, expected, atol=TOLERANCE)


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
