"""The commands, from the outside: what they write, refuse and survive."""

import json
import logging
import os
import signal
import subprocess
import sys
import time

import jax
import numpy as np
import pytest

import mimic
from mimic import compat

TINY = [
    "env=planar4dof",
    "env.demonstrations.count=4",
    "env.demonstrations.held_out=2",
    "trainer.num_envs=64",
    "trainer.batch_size=32",
    "trainer.num_minibatches=4",
    "trainer.num_updates_per_batch=1",
    "trainer.hidden_layers=[16]",
    "trainer.num_timesteps=5000",
    "trainer.evaluations=4",
]
REPORT_KEYS = {
    "env", "trainer", "seed", "optimality_gap", "mean_distance", "lower_bound", "hold_distance", "link_angle_error_deg",
    "torque_saturation", "wall_time_s", "env_steps", "steps_per_second", "hardware", "versions",
}  # fmt: skip


def command(module, *arguments, **more):
    return subprocess.run(
        [sys.executable, "-m", f"mimic.{module}", *arguments],
        capture_output=True,
        text=True,
        timeout=280,
        check=False,
        **more,
    )


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    """One tiny run, whose compiles are logged."""
    run_dir = tmp_path_factory.mktemp("runs") / "tiny"
    environment = {**os.environ, "JAX_LOG_COMPILES": "1"}
    result = command("train", *TINY, f"run_dir={run_dir}", "compilation_cache=", env=environment)
    assert result.returncode == 0, result.stderr[-2000:]
    return run_dir, result


def test_a_run_directory_holds_everything(finished):
    run_dir, _ = finished
    names = {path.name for path in run_dir.iterdir()}
    assert {"config.yaml", "report.json", "metrics.csv", "demonstrations.npz", "checkpoints", "tensorboard"} <= names
    report = json.loads((run_dir / "report.json").read_text())
    assert report.keys() >= REPORT_KEYS
    for key in ("optimality_gap", "mean_distance", "lower_bound", "hold_distance"):
        assert report[key].keys() == {"train", "held_out"}
    assert report["wall_time_s"].keys() == {"import", "build", "compile", "train", "evaluate", "total"}
    assert report["env_steps"] >= 5000
    assert len((run_dir / "metrics.csv").read_text().splitlines()) == 1 + 4


def test_brax_compiles_its_training_epoch_once(finished):
    """A sharding that differs from pmap's would show as a second long program `_fun`; resets are short."""
    _, result = finished
    finished_lines = [line for line in result.stderr.splitlines() if "Finished XLA compilation of jit(_fun)" in line]
    seconds = sorted((float(line.split(" in ")[-1].split()[0]) for line in finished_lines), reverse=True)
    assert seconds[0] > 4 * seconds[1], seconds
    evaluations = [line for line in result.stderr.splitlines() if "Finished XLA compilation of jit(program)" in line]
    assert 1 <= len(evaluations) <= 2


def test_evaluate_repeats_the_report(finished, tmp_path):
    run_dir, _ = finished
    out = tmp_path / "again.json"
    result = command("evaluate", f"run={run_dir}", f"out={out}")
    assert result.returncode == 0, result.stderr[-2000:]
    again, report = json.loads(out.read_text()), json.loads((run_dir / "report.json").read_text())
    for key in ("optimality_gap", "mean_distance", "lower_bound"):
        assert again[key] == pytest.approx(report[key], rel=1e-5)


def test_resume_goes_on_from_the_last_checkpoint(finished):
    run_dir, _ = finished
    result = command("train", f"resume={run_dir}", "trainer.num_timesteps=8000", "trainer.evaluations=1")
    assert result.returncode == 0, result.stderr[-2000:]
    assert json.loads((run_dir / "report.json").read_text())["env_steps"] >= 8000
    again = command("train", f"resume={run_dir}")
    assert again.returncode == 2 and "larger trainer.num_timesteps" in again.stderr


def test_training_ends_at_the_target_gap(tmp_path):
    run_dir = tmp_path / "early"
    result = command("train", *TINY, f"run_dir={run_dir}", "trainer.target_gap=100")
    assert result.returncode == 0, result.stderr[-2000:]
    assert len((run_dir / "metrics.csv").read_text().splitlines()) == 1 + 1
    assert json.loads((run_dir / "report.json").read_text())["env_steps"] < 5000


def test_a_signal_leaves_a_checkpoint_and_says_how_to_resume(tmp_path):
    run_dir = tmp_path / "stopped"
    arguments = [*TINY, f"run_dir={run_dir}", "trainer.num_timesteps=100000000", "trainer.evaluations=20000"]
    process = subprocess.Popen(
        [sys.executable, "-m", "mimic.train", *arguments], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )
    until = time.monotonic() + 200
    while time.monotonic() < until and len(list((run_dir / "checkpoints").glob("0*[1-9]*"))) < 1:
        assert process.poll() is None, process.communicate()[1][-2000:]
        time.sleep(0.2)
    process.send_signal(signal.SIGTERM)
    out, _ = process.communicate(timeout=60)
    assert process.returncode == 128 + signal.SIGTERM
    assert f"resume={run_dir}" in out.replace("\n", "")


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["env=panda5dof"], "unknown env 'panda5dof'; valid are panda3dof, panda4dof, panda7dof, planar4dof"),
        (["trainer=sac"], "unknown trainer 'sac'; valid are ppo"),
        (["env.previw=1"], "unknown key 'env.previw'; valid are"),
        (["seed=one"], "could not be converted to Integer"),
        (["env.learner.locked=[joint9]"], "unknown joint 'joint9'"),
        (["trainer.num_envs=500"], "must be a multiple of num_envs = 500"),
        (["env.demonstrations.path=missing.npz"], "no file"),
        (["resume=missing"], "not a run directory"),
        (["+foo=1"], "foo"),
        (["env.learner.locked=[3,joint3]"], "named twice"),
        (["env.learner.locked=[1,2,3,4,5,6,7]"], "all 7 joints are locked"),
        (["env.metric.correspondence=soft", "env.metric.xi=1"], "below 0"),
        (["env=planar4dof", "env.learner.link_lengths=[0.5,0]"], "above 0 [m]"),
    ],
)
def test_bad_input_is_one_line_and_exit_code_2(arguments, message, tmp_path):
    result = command("train", *arguments, cwd=tmp_path)
    assert result.returncode == 2
    assert result.stderr.count("\n") == 1 and message in result.stderr
    assert not list(tmp_path.iterdir())


def test_existing_run_dir_and_missing_checkpoint_are_refused(tmp_path):
    existing = command("train", f"run_dir={tmp_path}")
    assert existing.returncode == 2 and "exists" in existing.stderr
    (tmp_path / "config.yaml").write_text("seed: 0\n")
    for module, key in (("train", "resume"), ("evaluate", "run")):
        refused = command(module, f"{key}={tmp_path}")
        assert refused.returncode == 2 and refused.stderr.count("\n") == 1 and "no checkpoint" in refused.stderr


def test_help_names_the_environments():
    result = command("train", "--help")
    assert result.returncode == 0 and "panda4dof" in result.stdout and "resume=DIR" in result.stdout


@pytest.mark.parametrize(("version", "needed"), [("0.10.2", True), ("0.11.0", False), ("0.12.0.1", False)])
def test_the_cpu_flag_is_for_old_jax_alone(version, needed):
    assert compat.needs_cpu_flag(version) is needed


@pytest.mark.skipif(not compat.needs_cpu_flag(), reason="this jax does not need the flag and aborts on it")
def test_the_cpu_flag_speeds_up_kinematics(capsys):
    """Times MJX's kinematics of 64 Pandas with and without it, each in a process of its own."""
    code = (
        "import time, jax, jax.numpy as jnp, mujoco\nfrom mujoco import mjx\n"
        "from mimic.embodiment import panda_path\n"
        "model = mujoco.MjModel.from_xml_path(panda_path())\nmx = mjx.put_model(model)\ndata = mjx.make_data(model)\n"
        "f = jax.jit(jax.vmap(lambda q: mjx.kinematics(mx, data.replace(qpos=q)).xpos))\nq = jnp.zeros((64, 7))\n"
        "f(q).block_until_ready()\nstart = time.perf_counter()\n"
        "for _ in range(3): f(q).block_until_ready()\nprint((time.perf_counter() - start) / 3)\n"
    )
    seconds = []
    for flag in ("false", "true"):
        environment = {**os.environ, "XLA_FLAGS": f"--xla_cpu_use_fusion_emitters={flag}", "JAX_PLATFORMS": "cpu"}
        out = subprocess.run(
            [sys.executable, "-c", code], capture_output=True, text=True, env=environment, check=True
        ).stdout
        seconds.append(float(out.splitlines()[-1]))
    logging.getLogger(__name__).info("speed-up by the flag: %.0f", seconds[1] / seconds[0])
    with capsys.disabled():
        print(f"\nspeed-up of MJX kinematics by the CPU flag: {seconds[1] / seconds[0]:.0f} times")
    assert seconds[1] > 5 * seconds[0]  # several hundred times where it was measured first; 5 tells it from noise


def test_no_rollout_goes_below_the_bound():
    """Random controllers on the planar arm; 1e-4 is what the search may leave."""
    from mimic.envs.imitation import training_and_held_out
    from mimic.trainers.evaluation import Evaluator

    config = mimic.env_config("planar4dof", demonstrations={"count": 3, "held_out": 2})
    training, held_out = training_and_held_out(config)
    evaluator = Evaluator(mimic.ImitationEnv(config, training), held_out)
    rollout = jax.jit(lambda gain: evaluator.rollout(lambda obs: gain @ obs))
    size = evaluator.env.action_size, evaluator.env.observation_size
    for seed in range(5):
        gain = np.random.default_rng(seed).normal(size=size) * 0.02 * seed
        assert np.all(np.asarray(rollout(gain).distance) > evaluator.lower_bound - 1e-4)


def test_api_resolves():
    for name in mimic.__all__:
        assert getattr(mimic, name) is not None
