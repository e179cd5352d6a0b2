"""Start-up: heavy packages are imported only when they are needed."""

import subprocess
import sys

import pytest

from mimic.commands import cli

HEAVY = ("brax", "mujoco.mjx", "orbax", "matplotlib", "tensorboardX", "mink", "optax", "scipy", "trimesh")
REPORT = "\nfrom jax._src import xla_bridge\nassert not xla_bridge.backends_are_initialized()\nprint(*sys.modules)"


@pytest.mark.parametrize(
    "code",
    [
        "import mimic, sys\nmimic.make",
        "import sys\nfrom mimic import train\nfrom mimic.commands import cli\nsys.argv = ['mimic.train', '--help']\n"
        "try:\n    cli.run(train.prepare, 'train')\nexcept SystemExit:\n    pass",
    ],
    ids=["name", "help"],
)
def test_heavy_packages_are_imported_late(code):
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


@pytest.mark.parametrize("name", ["ImitationEnv", "export_run"])
def test_names_that_need_mjx_are_imported_without_a_word(name):
    """MJX prints two lines about Warp, an optional backend, once in a process."""
    code = f"import mimic\nmimic.{name}"
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert result.stdout == "" and "warp" not in result.stderr.lower()


def test_the_process_started_before_now():
    code = "import time\nfrom mimic.commands import cli\nprint(time.perf_counter() - cli.process_started())"
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert 0 <= float(result.stdout) < 60  # imports, on a busy machine; a wrong clock would be off by its uptime
    assert cli.process_started() == pytest.approx(cli.process_started(), abs=0.05)  # ticks of 0.01 s
