"""Start-up: heavy packages are imported only when they are needed."""

import pathlib
import subprocess
import sys

from mimic.commands import cli

HEAVY = ("brax", "mujoco.mjx", "orbax", "matplotlib", "tensorboardX", "mink", "optax", "scipy", "trimesh")
REPORT = "\nfrom jax._src import xla_bridge\nassert not xla_bridge.backends_are_initialized()\nprint(*sys.modules)"


def test_heavy_packages_are_imported_late():
    """Neither by the names of the library nor by `--help`."""
    code = "import mimic, sys\nmimic.make\nfrom mimic import train\nfrom mimic.commands import cli\n"
    code += "sys.argv = ['mimic.train', '--help']\ncli.run(train.prepare, 'train')"
    result = subprocess.run([sys.executable, "-c", code + REPORT], capture_output=True, text=True, check=False)
    assert result.returncode == 0, result.stderr[-2000:]
    imported = set(result.stdout.splitlines()[-1].split())
    assert "mimic.envs.config" in imported
    assert not imported.intersection(HEAVY)


def test_import_mimic_imports_no_other_package():
    """Each public name imports what it needs at its first use; `mimic.deploy` runs where nothing else is installed."""
    code = "import mimic, sys\nfor name in [*sys.modules]: print(name.partition('.')[0], end=' ')"
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert not set(result.stdout.split()).intersection({"jax", "mujoco", "brax", "flax", "numpy", "omegaconf"})


def test_pose_mappers_need_no_simulator():
    code = "import sys\nfrom mimic.commands import retarget\nfrom mimic.evaluation import plots"
    code += "\nfrom mimic.trainers import run_training"
    code += "\nfrom mimic.trainers.pose_mapper import trainer\nprint(*sys.modules)"
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    imported = set(result.stdout.splitlines()[-1].split())
    assert "mimic.trainers.pose_mapper.model" in imported and not imported.intersection({"brax", "mujoco.mjx"})


def test_training_needs_no_meshes_and_no_contacts():
    """Those of MJX and brax are imported late, when something uses them."""
    code = "import sys\nfrom mimic.base import compat\ncompat.import_mjx()\nfrom mimic.trainers import run_training"
    code += "\nfrom mimic.trainers.ppo import trainer"
    code += "\nprint(*sys.modules)"
    code += "\nimport jaxopt\nfrom mujoco.mjx._src import mesh\nassert mesh.trimesh.Trimesh and jaxopt.projection"
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert result.returncode == 0, result.stderr[-2000:]
    imported = set(result.stdout.splitlines()[-1].split())
    assert "brax" in imported and not imported.intersection({"scipy.optimize", "scipy.spatial", "trimesh"})


def test_mjx_and_what_a_view_shows_are_imported_without_a_word_and_without_viser():
    """MJX prints two lines about Warp, an optional backend, once in a process. Only the page of a view needs viser."""
    shown = ("html", "live_session", "playback", "meshes", "tracking", "history", "captured")
    code = "import sys\nsys.modules['viser'] = None\nimport mimic\nmimic.metric.distance, mimic.arms.arm\n"
    code += "mimic.retargeting.pose, mimic.envs.config.EnvConfig, mimic.fit, mimic.export_run, mimic.ImitationEnv\n"
    code += "import mimic.commands.view_any_arm\n" + "\n".join(f"import mimic.viewer.{name}" for name in shown)
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert result.stdout == "" and "warp" not in result.stderr.lower()


def test_a_process_started_after_this_one(monkeypatch):
    """Both by `time.perf_counter`."""
    own = cli.process_started()
    with subprocess.Popen(["cat"], stdin=subprocess.PIPE) as other:
        monkeypatch.setattr(cli, "Path", lambda _: pathlib.Path(f"/proc/{other.pid}/stat"))
        started = cli.process_started()
    assert own < started  # how near to now depends on the clocks of a machine that was suspended
