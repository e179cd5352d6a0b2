"""`python -m mimic.dataset`: rollouts and motions as datasets, back from them, and what is rejected."""

import dataclasses
import json
import sys
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import mimic
from mimic.commands import dataset as command
from mimic.commands.config import DatasetConfig
from mimic.commands.dataset import prepare_dataset
from mimic.commands.dataset_sources import rollout_episodes, steps_before_runaway
from mimic.envs.make import make_env
from mimic.evaluation.evaluator import Evaluator
from mimic.evaluation.labels import SPLITS
from mimic.motions.formats.episodes import ANGLE, VELOCITY
from mimic.runs.checkpoints import load_checkpoint
from mimic.trainers.run_config import load_config
from tests.helpers.commands import run
from tests.helpers.run_directories import write_run
from tests.helpers.untrained_run import COUNT, HELD_OUT, HORIZON, environment, untrained_run

pq = pytest.importorskip("pyarrow.parquet")
pytest.importorskip("rosbags")
from rosbags.highlevel import AnyReader  # noqa: E402


@pytest.fixture(scope="module")
def run_dir(tmp_path_factory):
    """A run, whose policy is restored and rolled out once for all tests."""
    folder = untrained_run(tmp_path_factory.mktemp("runs") / "run")

    trainer = command.make_ppo_trainer(load_config(folder), folder)
    rollouts = trainer.evaluate(load_checkpoint(folder, trainer.params_template())[1])
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(command, "make_ppo_trainer", lambda *_: trainer)
        patch.setattr(trainer, "evaluate", lambda _: rollouts)
        yield folder


@pytest.fixture(scope="module")
def recorded(tmp_path_factory):
    """Demonstrations of a Panda."""
    path = tmp_path_factory.mktemp("demonstrations") / "panda.npz"
    mimic.record_demonstrations(mimic.build_arm(mimic.ArmConfig()), 3).save(path)
    return path


def write(out, **settings):
    prepare_dataset(DatasetConfig(out=str(out), compilation_cache="", **settings))()
    return out


@pytest.fixture(scope="module")
def written(run_dir, tmp_path_factory):
    """The rollouts of the run."""
    return write(tmp_path_factory.mktemp("written") / "lerobot", run=str(run_dir))


def frames(folder):
    """The columns of the data [episodes, steps, numbers] of episodes of one length."""
    table, info = (
        pq.read_table(folder / "data/chunk-000/file-000.parquet"),
        json.loads((folder / "meta/info.json").read_text()),
    )
    count = info["total_episodes"]
    return {name: np.array(table[name].to_pylist()).reshape(count, HORIZON, -1) for name in table.column_names}


def test_the_actions_lead_from_each_state_to_the_next(written):
    """The environment steps from each frame with the frame's torque, and arrives in the next one."""
    columns = frames(written)
    rows = pq.read_table(written / "meta/episodes/chunk-000/file-000.parquet")
    final = np.array(rows["final/observation.state"].to_pylist())
    env = make_env(environment())
    states = np.concatenate([columns["observation.state"], final[:, None]], axis=1)
    assert np.ptp(columns["action"]) > 0.1  # N m: a check that can fail

    def advance(state, torque):
        start = env.start(jax.random.PRNGKey(0), 0)
        qpos, qvel = jnp.split(state, 2)
        moved = dataclasses.replace(start, qpos=qpos, qvel=qvel)
        after = env.step(env.begin(start).replace(pipeline_state=moved), torque / env.torque_scale).pipeline_state
        return jnp.concatenate([after.qpos, after.qvel])

    reached = jax.jit(jax.vmap(jax.vmap(advance)))(jnp.asarray(states[:, :-1], jnp.float32), columns["action"])
    np.testing.assert_allclose(reached, states[:, 1:], rtol=0, atol=1e-4)  # rad, rad/s: float32, compiled anew
    np.testing.assert_array_equal(states[:, 0], np.zeros((COUNT + HELD_OUT, 4)))  # the start pose, at rest


def test_the_expert_of_a_rollout_is_its_demonstration(run_dir, written):
    demonstrations = mimic.load_demonstrations(run_dir / "demonstrations.npz")
    columns = frames(written)
    expected = np.concatenate([demonstrations.qpos, demonstrations.qvel], axis=-1)[:, :-1]
    np.testing.assert_array_equal(columns["observation.environment_state"], expected.astype(np.float32))
    info = json.loads((written / "meta/info.json").read_text())
    assert info["splits"] == {"train": f"0:{COUNT}", "held_out": f"{COUNT}:{COUNT + HELD_OUT}"}
    facts = json.loads((written / "meta/mimic.json").read_text())
    assert (facts["control"], facts["checkpoint"], facts["env"]) == ("torque", 0, "planar4dof")


def test_a_split_of_a_run(run_dir, written, tmp_path):
    both, held_out = frames(written), frames(write(tmp_path / "b", run=str(run_dir), split="held_out"))
    assert len(held_out["action"]) == HELD_OUT
    for name in ("observation.state", "action", "observation.environment_state"):
        np.testing.assert_array_equal(held_out[name], both[name][COUNT:])


def test_rollouts_as_bags_are_the_same(run_dir, written, tmp_path):
    out = tmp_path / "bags"
    text = run("dataset", f"run={run_dir}", f"out={out}", "format=rosbag2", "compilation_cache=")
    assert f"{COUNT + HELD_OUT} episodes ({COUNT} train, {HELD_OUT} held_out)" in text
    assert "commands: torque [N m]" in text and text.endswith(f"results: {out}\n")
    columns = frames(written)
    for episode in (0, COUNT):
        with AnyReader([out / f"episode_{episode:06d}"]) as reader:
            rows: list[tuple[str, Any]] = [
                (c.topic, reader.deserialize(raw, c.msgtype)) for c, _, raw in reader.messages()
            ]
        position = [message.position for topic, message in rows if topic == "/learner/joint_states"]
        torque = [message.effort for topic, message in rows if topic == "/learner/joint_commands"]
        assert len(position) == HORIZON + 1
        np.testing.assert_allclose(position[:-1], columns["observation.state"][episode, :, :2], rtol=0, atol=1e-6)
        np.testing.assert_allclose(torque, columns["action"][episode], rtol=0, atol=1e-6)  # float32


def test_demonstrations_come_back_from_a_dataset(recorded, tmp_path, monkeypatch):
    monkeypatch.setattr("mimic.commands.demonstrations.plot_demonstrations", lambda *_, **__: None)
    dataset = write(tmp_path / "set", demonstrations=str(recorded), format="rosbag2")
    text = run("demonstrations", f"source={dataset}", f"out={tmp_path / 'back.npz'}")
    assert (
        "set: 3 demonstrations, 50 steps of 0.1 s\n3 motions, 15 s, 10 samples a second; velocities: from the source"
        in text
    )
    before, after = mimic.load_demonstrations(recorded), mimic.load_demonstrations(tmp_path / "back.npz")
    np.testing.assert_allclose(after.qpos, before.qpos, rtol=0, atol=1e-12)
    np.testing.assert_allclose(after.qvel, before.qvel, rtol=0, atol=1e-12)


@pytest.mark.parametrize("format", ["lerobot", "rosbag2"])
def test_a_gripper_comes_back_from_a_dataset(recorded, tmp_path, format):
    before = mimic.load_demonstrations(recorded)
    opening = 100 * np.random.default_rng(0).random((before.count, before.horizon + 1, 1))
    path = tmp_path / "gripper.npz"
    dataclasses.replace(before, torque=None, gripper=opening, gripper_names=("jaw",)).save(path)
    dataset = write(tmp_path / "set", demonstrations=str(path), format=format)
    after, _ = mimic.import_demonstrations(dataset, mimic.panda())
    assert after.gripper_names == ("jaw",) and after.gripper is not None
    np.testing.assert_allclose(after.gripper, opening, atol=1e-5)  # percent in single precision
    np.testing.assert_allclose(after.qpos, before.qpos, rtol=0, atol=2e-7)  # rad: single precision of up to 3 rad
    np.testing.assert_allclose(after.qvel, before.qvel, rtol=0, atol=2e-7)


def test_a_runaway_ends_an_episode():
    qvel = np.ones((4, 5, 2))
    qvel[1, 3, 0], qvel[2, 0, 1], qvel[3, 4] = 30.0, -40.0, np.nan
    assert steps_before_runaway(qvel, 30.0).tolist() == [5, 3, 0, 4]


def test_a_policy_of_runaways_is_an_error(run_dir, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(
        "mimic.commands.dataset_sources.steps_before_runaway", lambda qvel, bound: np.zeros(len(qvel), int)
    )
    config = DatasetConfig(run=str(run_dir), out=str(tmp_path / "set"), compilation_cache="")
    assert prepare_dataset(config)() == 1
    assert capsys.readouterr().err == "error: no episode to write: each rollout of this policy is a runaway\n"
    assert not list(tmp_path.iterdir())


def test_rollouts_that_a_runaway_cuts_short_are_counted(run_dir, tmp_path, monkeypatch, capsys):
    cut = np.array([HORIZON, 3, 0, HORIZON, HORIZON, HORIZON])
    monkeypatch.setattr("mimic.commands.dataset_sources.steps_before_runaway", lambda qvel, bound: cut)
    write(tmp_path / "set", run=str(run_dir))
    assert "5 episodes (3 train, 2 held_out), 83 steps" in (text := capsys.readouterr().out)
    assert "2 rollouts end before the step in which a joint exceeds 30 rad/s" in text
    rows = pq.read_table(tmp_path / "set/meta/episodes/chunk-000/file-000.parquet").to_pylist()
    assert [row["demonstration"] for row in rows] == [0, 1, 3, 0, 1]
    assert [row["length"] for row in rows] == [HORIZON, 3, *[HORIZON] * 3]


@pytest.mark.slow
@pytest.mark.parametrize(("control", "quantity"), [("joint_velocity", VELOCITY), ("joint_position", ANGLE)])
def test_rollouts_with_an_inner_loop_have_its_targets(control, quantity):
    """A target angle is where the reference goes, and a target velocity the one that it takes on."""
    env = mimic.make(
        "panda4dof", world="nominal", control=control, demonstrations={"count": 1, "held_out": 1}, horizon=6
    )
    evaluator = Evaluator(env, env.demonstrations)
    action = jnp.linspace(-0.2, 0.2, env.action_size)
    rollouts = jax.jit(lambda: evaluator.rollout(lambda state: action))()
    episodes, _ = rollout_episodes(evaluator, rollouts, SPLITS, "", {})
    assert episodes.robot.quantity == quantity
    command, parameters = np.asarray(episodes.robot.command)[0], env.plant.constants.parameters
    if control == "joint_velocity":
        np.testing.assert_allclose(command, np.tile(action * parameters.velocity[:4], (6, 1)), rtol=1e-5)
    else:
        np.testing.assert_allclose(command[0], env.start_poses[0] + action * parameters.reach[:4], rtol=1e-5)
    moved = episodes.robot.qpos[0, -1] - episodes.robot.qpos[0, 0]
    assert np.all(np.sign(moved) == np.sign(action))


def test_nothing_is_left_where_writing_fails(recorded, tmp_path, monkeypatch):
    def fail(folder, *_):
        (folder / "half").write_text("")
        raise OSError("disk full")

    monkeypatch.setattr(command, "write_lerobot", fail)
    with pytest.raises(OSError, match="disk full"):
        write(tmp_path / "set", demonstrations=str(recorded))
    assert not list(tmp_path.iterdir())


def test_a_missing_package_is_named(reason, recorded, monkeypatch):
    monkeypatch.setitem(sys.modules, "rosbags", None)
    line = reason("dataset", f"demonstrations={recorded}", "out=new", "format=rosbag2")
    assert "format=rosbag2 needs the package rosbags: pip install 'mimic-arms[datasets]'" in line


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["out=new"], "expected one of them, as in run=runs/NAME or demonstrations=FILE.npz, got neither"),
        (["demonstrations={npz}"], "out: expected a folder"),
        (["demonstrations={npz}", "out={npz}"], "exists; name a new folder"),
        (["demonstrations=nothing.npz", "out=new"], "no file at 'nothing.npz'"),
        (["demonstrations={npz}", "out=new", "format=hdf5"], "format: expected one of lerobot, rosbag2, got 'hdf5'"),
        (["demonstrations={npz}", "out=new", "split=train"], "split: expected none without run="),
        (["run={run}", "out=new", "checkpoint=5"], "checkpoint"),
    ],
)
def test_bad_input_of_the_command(reason, recorded, run_dir, arguments, message):
    given = (argument.format(npz=recorded, run=run_dir) for argument in arguments)
    assert message in reason("dataset", *given, "compilation_cache=")


def test_runs_of_another_trainer_are_rejected(reason, tmp_path):
    run_dir = write_run(tmp_path / "mapper", [0.1], trainer="pose_mapper")
    line = reason("dataset", f"run={run_dir}", "out=new", "compilation_cache=")
    assert "expected a run of trainer=ppo, got one of pose_mapper" in line


def test_a_time_step_that_lerobot_does_not_have(reason, recorded, tmp_path):
    path = tmp_path / "odd.npz"
    dataclasses.replace(mimic.load_demonstrations(recorded), dt=0.03).save(path)
    assert "as LeRobot counts whole frames per second" in reason("dataset", f"demonstrations={path}", "out=new")
    write(tmp_path / "bags", demonstrations=str(path), format="rosbag2")


def test_what_the_command_prints(recorded, tmp_path):
    assert run("dataset", f"demonstrations={recorded}", f"out={tmp_path / 'set'}") == (
        "3 episodes (3 train), 150 steps of 0.1 s\nrobot: panda, 7 joints\n"
        f"action: torque [N m], commanded; constant in the step\nresults: {tmp_path / 'set'}\n"
    )
    assert [path.name for path in tmp_path.iterdir()] == ["set"]
