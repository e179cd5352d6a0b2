"""What happens before the first training step: nothing heavy is imported, compiled or computed that is not needed."""

import copy
import os
import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hydra.core.config_store import ConfigStore

import mimic
from mimic import cli, compat, compilation
from mimic.compilation import Background, compiler_options
from mimic.envs.imitation import training_and_held_out
from mimic.envs.wrappers import wrap_for_training
from mimic.evaluation import evaluator as evaluation
from mimic.evaluation.evaluator import Evaluator
from mimic.metric.kinematics import link_state_table
from mimic.trainers.config import PRESETS, PPOConfig

HEAVY = ("brax", "mujoco.mjx", "orbax", "matplotlib", "tensorboardX", "mink", "optax", "scipy", "trimesh")
REPORT = "\nfrom jax._src import xla_bridge\nassert not xla_bridge.backends_are_initialized()\nprint(*sys.modules)"


@pytest.mark.parametrize(
    "code",
    [
        "import mimic, sys",
        "import sys\nfrom mimic import cli, train\nsys.argv = ['mimic.train', '--help']\n"
        "try:\n    cli.run(train.prepare, 'train')\nexcept SystemExit:\n    pass",
    ],
    ids=["import", "help"],
)
def test_what_is_heavy_is_imported_when_it_is_needed(code):
    result = subprocess.run([sys.executable, "-c", code + REPORT], capture_output=True, text=True, check=False)
    assert result.returncode == 0, result.stderr[-2000:]
    imported = set(result.stdout.splitlines()[-1].split())
    assert "mimic.envs.config" in imported
    assert not imported.intersection(HEAVY)


def test_pose_mappers_need_no_simulator():
    code = "import sys\nfrom mimic.commands import retarget, train\nfrom mimic.evaluation import plots"
    code += "\nfrom mimic.trainers.pose_mapper import trainer\nprint(*sys.modules)"
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    imported = set(result.stdout.splitlines()[-1].split())
    assert "mimic.trainers.pose_mapper.model" in imported and not imported.intersection({"brax", "mujoco.mjx"})


def test_training_needs_no_meshes_and_no_contacts():
    """Of MJX and brax; what is put off is there when it is asked for."""
    code = "import sys\nfrom mimic import compat\ncompat.import_mjx()\nfrom mimic.commands import train"
    code += "\nfrom mimic.trainers.ppo import trainer"
    code += "\nprint(*sys.modules)"
    code += "\nimport jaxopt\nfrom mujoco.mjx._src import mesh\nassert mesh.trimesh.Trimesh and jaxopt.projection"
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert result.returncode == 0, result.stderr[-2000:]
    imported = set(result.stdout.splitlines()[-1].split())
    assert "brax" in imported and not imported.intersection({"scipy.optimize", "scipy.spatial", "trimesh"})


def test_what_is_imported_later_runs_once_and_may_be_missing(tmp_path, monkeypatch):
    (tmp_path / "waiting").mkdir()
    (tmp_path / "waiting" / "__init__.py").write_text("raise SystemExit('the parent was imported')")
    (tmp_path / "waiting" / "part.py").write_text("import sys\nsys.modules['runs'].append(__name__)\nvalue = 3")
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setitem(sys.modules, "runs", [])
    for name in ("waiting.part", "waiting.missing", "missing"):
        compat._import_later(name)
    part = sys.modules.pop("waiting.part")
    assert sys.modules["runs"] == []
    assert part.value == part.value == 3
    assert sys.modules["runs"] == ["waiting.part"] and not {"waiting.missing", "missing"}.intersection(sys.modules)


def test_the_process_started_before_now():
    code = "import time\nfrom mimic import cli\nprint(time.perf_counter() - cli.process_started())"
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert 0 <= float(result.stdout) < 60  # imports, on a busy machine; a wrong clock would be off by its uptime
    assert cli.process_started() == pytest.approx(cli.process_started(), abs=0.05)  # ticks of 0.01 s


def test_the_table_of_link_states_is_what_they_are():
    arm = mimic.panda(locked=[3])
    qpos, qvel = np.random.default_rng(0).normal(size=(2, 3, 4, arm.num_joints))
    table = link_state_table(arm, qpos, qvel)
    one_by_one = jax.vmap(jax.vmap(lambda *motion: mimic.link_states(arm, *motion)))(
        jnp.asarray(qpos), jnp.asarray(qvel)
    )
    for name, values in vars(one_by_one).items():
        found = getattr(table, name)
        assert isinstance(found, np.ndarray) and found.dtype == np.float32
        np.testing.assert_allclose(found, values, atol=1e-5)  # float32 against float64 that is rounded


def test_a_learner_that_can_do_what_the_expert_does_needs_no_search(monkeypatch):
    monkeypatch.setattr(evaluation, "closest_motion", None)  # would fail
    config = mimic.env_config("panda7dof", demonstrations={"count": 2, "held_out": 1}, physics="fused")
    training, held_out = training_and_held_out(config)
    evaluator = Evaluator(mimic.ImitationEnv(config, training), held_out)
    assert evaluator.lower_bound.shape == evaluator.hold_distance.shape == (3, 50)
    assert not evaluator.lower_bound.any() and evaluator.hold_distance[:, -1].min() > 0.01


def test_observations_of_fresh_episodes_fit_their_states():
    """In a batch of which some episodes end: the wrapper puts the observations together by itself."""
    env = mimic.make("planar4dof", demonstrations={"count": 3}, physics="fused")
    wrapped = wrap_for_training(env, env.config.horizon + 1)
    state = jax.jit(wrapped.reset)(jax.random.split(jax.random.PRNGKey(0), 16))
    step, observe = jax.jit(wrapped.step), jax.jit(jax.vmap(env.observe))
    ended = 0.0
    for _ in range(12):
        np.testing.assert_allclose(state.obs, observe(state.pipeline_state), atol=1e-5)
        state = step(state, jnp.full((16, env.action_size), 0.3))
        ended += float(state.done.sum())
    assert ended > 0


def test_what_is_prepared_is_made_once():
    made = []
    lazy, started = Background(lambda: made.append("lazy")), Background(lambda: made.append("started"))
    started.start()
    started.start()
    for program in (started, started, lazy, lazy):
        program()
    assert made == ["started", "lazy"]
    failing = Background(lambda: 1 / 0)
    failing.start()
    with pytest.raises(ZeroDivisionError):
        failing()


@pytest.mark.parametrize(("a_process_for_each", "count"), [(False, 2), (True, 3)])
def test_options_for_gpus_are_known_to_jaxlib(monkeypatch, a_process_for_each, count):
    """Which takes them on CPUs too, and refuses a wrong name or value."""
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    monkeypatch.setattr(compilation, "a_process_for_each_gpu", lambda: a_process_for_each)
    options = compiler_options()
    assert len(options) == count
    assert jax.jit(lambda x: x + 1, compiler_options=options)(1.0) == 2.0


def test_what_is_compiled_beside_a_training_is_compiled_with_them(monkeypatch):
    monkeypatch.setattr(compilation, "compiler_options", lambda: {"no_option_of_xla": True})
    with pytest.raises(jax.errors.JaxRuntimeError, match="no_option_of_xla"):
        compilation.compiling(lambda x: x + 1, jnp.zeros(3))()


def test_xla_flags_of_the_user_stay(monkeypatch):
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    boolean, scheduling = compiler_options()
    monkeypatch.setenv("XLA_FLAGS", f"--xla_dump_to=/tmp --{scheduling}=LHS")
    assert list(compiler_options()) == [boolean]
    monkeypatch.setenv("XLA_FLAGS", f"--{boolean}")
    assert list(compiler_options()) == [scheduling]


def test_a_run_with_a_target_looks_more_often():
    usual, targeted = (PPOConfig(target_gap=gap).resolve("cpu").evaluations for gap in (0.0, 0.02))
    assert usual and targeted
    assert usual == PRESETS["cpu"]["evaluations"] and targeted > usual
    assert PPOConfig(target_gap=0.02, evaluations=3).resolve("cpu").evaluations == 3


def test_tensorboard_does_not_bring_torch(tmp_path):
    (tmp_path / "torch.py").write_text("raise SystemExit('torch was imported')")
    code = "import sys\nfrom mimic import compat\ncompat.import_tensorboard().SummaryWriter"
    code += "\nassert 'torch' not in sys.modules"
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([str(tmp_path), *filter(None, sys.path)])}
    subprocess.run([sys.executable, "-c", code], env=environment, check=True)


def test_hydra_shares_what_is_registered_and_copies_what_it_loads(monkeypatch):
    monkeypatch.setattr(ConfigStore, "__deepcopy__", None, raising=False)  # to be put back
    compat.share_config_store()
    store = ConfigStore.instance()
    assert copy.deepcopy(store) is store
    monkeypatch.setattr(store, "repo", {})
    store.store(name="tried", node={"list": [1]})
    store.load("tried.yaml").node["list"].append(2)
    assert store.load("tried.yaml").node == {"list": [1]}
