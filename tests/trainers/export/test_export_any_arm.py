"""`python -m mimic.export` of a policy of many arms: one function for all of them, with the arm as an input."""

import dataclasses
import json

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

import mimic
from mimic.arms.arrays import MAX_JOINTS
from mimic.arms.description import description, description_layout, description_size
from mimic.arms.sampler import random_arm
from mimic.envs.many_arms import any_arm_state
from mimic.retargeting.array_goals import random_numbers
from mimic.runs.checkpoints import load_checkpoint, save_checkpoint
from mimic.trainers.make import make_ppo_trainer
from mimic.trainers.pose_mapper.mapper_arm import describe_arm
from mimic.trainers.run_config import load_config
from tests.helpers.random_arms import random_arm as random_model
from tests.helpers.untrained_run import FAMILY, family, untrained_run

pytest.importorskip("onnx")
onnxruntime = pytest.importorskip("onnxruntime")
DYNAMICS = {"has_dynamics": True}


@pytest.fixture(scope="module")
def run_dir(tmp_path_factory):
    return untrained_run(tmp_path_factory.mktemp("runs") / "run", family())


def described(run_dir, out, **options):
    """The vector that the command writes for an arm."""
    mimic.export_run(run_dir, out, **options)
    return np.asarray(json.loads(out.read_text())["learner"], np.float32)


def part(vector, name):
    """A part of a description."""
    (place,) = (place for place in description_layout(**DYNAMICS) if place["name"] == name)
    return vector[..., place["start"] : place["stop"]].reshape(*vector.shape[:-1], *place["shape"])


@pytest.mark.slow
def test_a_description_has_the_dynamics_and_the_maximum_torque(run_dir, tmp_path):
    env = load_config(run_dir).env
    vector = described(run_dir, tmp_path / "panda.json", learner="panda", locked=[2, "joint4"])
    assert vector.shape == (description_size(**DYNAMICS),)
    assert part(vector, "is_free").tolist() == [1, 0, 1, 0, 1, 1, 1, 0]
    torque = part(vector, "torque_limit")
    assert np.all((torque > 0) == (part(vector, "is_free") > 0))
    panda = describe_arm(env, "panda").data
    np.testing.assert_allclose(part(vector, "second_moment"), panda.second_moment, rtol=1e-6)
    np.testing.assert_array_equal(vector[: description_size()], description(with_locks(panda, [1, 3])))
    whole = described(run_dir, tmp_path / "whole.json", learner="panda")
    # A joint carries more inertia where the joints after it are locked.
    assert np.all(part(whole, "torque_limit")[[0, 2]] < torque[[0, 2]])


def with_locks(arm, joints):
    is_free = arm.is_free.copy()
    is_free[joints] = 0
    return dataclasses.replace(arm, is_free=is_free)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (
            ["out=new.onnx", "locked=[2]"],
            "locked: expected with learner=NAME, as in learner=panda locked=[2,4], got [2]",
        ),
        (["out=new.onnx", "learner=panda"], "out: expected a file .json for the description of learner=panda"),
        (["out=new.json", "learner=no_such_arm"], "model: expected panda, planar, panda_pair, an MJCF or URDF file"),
        (["out=new.json", "learner=panda", "checkpoint=6"], "has no checkpoint 6; it has "),
    ],
)
def test_bad_input_is_rejected(run_dir, reason, arguments, message):
    assert message in reason("export", f"run={run_dir}", *arguments)


def test_an_arm_that_evaluate_rejects_has_no_description(run_dir, reason, tmp_path):
    """Of 9 joints, one of them locked: a policy moves arms of up to 8, locked ones included."""
    model = tmp_path / "nine.xml"
    mujoco.mj_saveLastXML(str(model), random_model(0, joints=9))
    error = reason("export", f"run={run_dir}", "out=new.json", f"learner={model}", "locked=[1]")
    assert "expected at most 8 joints and 12 links, got 9 and 9" in error


@pytest.mark.slow
def test_an_onnx_policy_of_any_arm_equals_the_environment(run_dir, tmp_path):
    """An episode of three arms: the torques of the file in the states of the environment, with a memory of its own."""
    trained = load_config(run_dir)
    trainer = make_ppo_trainer(trained, run_dir)
    statistics, *networks = load_checkpoint(run_dir, trainer.params_template(), 0)[1]
    rng = np.random.default_rng(0)  # the initial actions are 0
    networks = jax.tree.map(lambda x: x + 0.2 * rng.normal(size=x.shape).astype(x.dtype), networks)
    save_checkpoint(run_dir, 1, (statistics, *networks))
    session = onnxruntime.InferenceSession(str(mimic.export_run(run_dir, tmp_path / "policy.onnx")))
    env, policy = trainer.evaluator.env, trainer.policy((statistics, *networks))
    panda = jax.tree.map(jnp.asarray, describe_arm(trained.env, "panda").data)
    locked = dataclasses.replace(panda, is_free=panda.is_free.at[jnp.array([1, 4])].set(0))
    arms = jax.tree.map(lambda *x: jnp.stack(x), panda, locked, random_arm(jax.random.PRNGKey(1)))
    key, motions = jax.random.PRNGKey(0), env.demonstrations

    @jax.jit
    @jax.vmap
    def start(arm):
        return env.begin(env.start_of(arm, jnp.asarray(1), key))

    @jax.jit
    @jax.vmap
    def step(state):
        action = jnp.clip(policy(state.obs), -1, 1)
        torques = [env.command(any_arm_state(state), used) for used in (action, jnp.zeros(MAX_JOINTS))]
        return env.step(state, action), torques

    state = start(arms)
    at_start = any_arm_state(state)
    vectors = [description(jax.tree.map(lambda x, i=i: np.asarray(x[i]), arms), **DYNAMICS) for i in range(3)]
    learner = np.stack(vectors)
    part(learner, "torque_limit")[:] = at_start.max_torque
    memory = np.tile(at_start.qpos, (1, session.get_inputs()[5].shape[1] // MAX_JOINTS))
    for number in range(FAMILY["horizon"]):
        now = any_arm_state(state)
        inputs = {
            "expert_qpos": motions.qpos[1, number + 1], "expert_qvel": motions.qvel[1, number + 1],
            "random": np.ravel(random_numbers(key, jnp.asarray(number))),
        }  # fmt: skip
        inputs = {name: np.tile(value, (3, 1)) for name, value in inputs.items()}
        inputs |= {"learner": learner, "qpos": now.qpos, "qvel": now.qvel, "memory": memory}
        inputs = {name: np.asarray(value, np.float32) for name, value in inputs.items()}
        outputs = ["torque", "controller_torque", "next_memory"]
        rows = [session.run(outputs, {name: value[i : i + 1] for name, value in inputs.items()}) for i in range(3)]
        torque, controller_torque, memory = map(np.concatenate, zip(*rows, strict=True))
        state, expected = step(state)
        unit = np.maximum(now.max_torque, 1e-6)
        for name, got, value in zip(outputs, (torque, controller_torque), expected, strict=False):
            np.testing.assert_allclose(got / unit, value / unit, atol=2e-3, err_msg=f"{name} at step {number}")
        np.testing.assert_allclose(memory[:, :MAX_JOINTS], any_arm_state(state).followed.goal.qpos, atol=2e-3)
        assert np.abs(torque - controller_torque).max() > 1e-2  # the policy does something
    metadata = session.get_modelmeta().custom_metadata_map
    assert json.loads(metadata["learner_layout"])[-1]["stop"] == learner.shape[1]
    assert set(json.loads(metadata["inputs"])) == {value.name for value in session.get_inputs()}
