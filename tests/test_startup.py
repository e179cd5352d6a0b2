"""Start-up: heavy packages are imported only when they are needed, and nothing is printed meanwhile."""

import json
import os
import subprocess
import sys

import pytest

from mimic.commands import cli

HEAVY = {"brax", "mujoco.mjx", "orbax", "matplotlib", "tensorboardX", "mink", "optax", "scipy", "trimesh"}
SHOWN = ("html", "live_session", "playback", "meshes", "tracking", "captured")  # by the page of a view
STEPS = {
    "mimic": "import mimic",
    "help": """
from jax._src import xla_bridge
mimic.make
from mimic import train
from mimic.commands import cli
sys.argv = ["mimic.train", "--help"]
with contextlib.redirect_stdout(io.StringIO()), contextlib.suppress(SystemExit):
    cli.run(train.prepare, "train")
assert not xla_bridge.backends_are_initialized()
""",
    "pose mapper": """
from mimic.commands import retarget
from mimic.evaluation import plots
from mimic.trainers import run_training
from mimic.trainers.pose_mapper import trainer
""",
    "training": "from mimic.trainers.ppo import trainer",
    "meshes and contacts": """
import jaxopt
from mujoco.mjx._src import mesh
assert mesh.trimesh.Trimesh and jaxopt.projection
""",
    "everything": """
mimic.metric.distance, mimic.arms.arm, mimic.retargeting.pose, mimic.envs.config.EnvConfig, mimic.fit
mimic.export_run, mimic.ImitationEnv
"""
    + "\n".join(f"import mimic.viewer.{name}" for name in SHOWN),
}


@pytest.fixture(scope="module")
def imported():
    """The modules of a process without viser after each of these steps; the process must print nothing else."""
    code = "import contextlib, io, json, sys\nsys.modules['viser'] = None\nmodules = {}\n"
    code += "".join(f"{step}\nmodules[{name!r}] = [*sys.modules]\n" for name, step in STEPS.items())
    command = [sys.executable, "-c", code + "print(json.dumps(modules))"]
    result = subprocess.run(command, capture_output=True, text=True, check=False)
    assert result.returncode == 0, result.stderr[-2000:]
    (line,) = result.stdout.splitlines()  # MJX prints two lines about Warp, an optional backend
    assert "warp" not in result.stderr.lower()
    return {name: set(modules) for name, modules in json.loads(line).items()}


def test_import_mimic_imports_no_other_package(imported):
    """Each public name imports what it needs at its first use; `mimic.deploy` runs where nothing else is installed."""
    packages = {name.partition(".")[0] for name in imported["mimic"]}
    assert not packages & {"jax", "mujoco", "brax", "flax", "numpy", "omegaconf"}


def test_heavy_packages_are_imported_late(imported):
    """Neither by the names of the library nor by `--help`."""
    assert "mimic.envs.config" in imported["help"] and not imported["help"] & HEAVY


def test_pose_mappers_need_no_simulator(imported):
    assert "mimic.trainers.pose_mapper.model" in imported["pose mapper"]
    assert not imported["pose mapper"] & {"brax", "mujoco.mjx"}


def test_training_needs_no_meshes_and_no_contacts(imported):
    """Those of MJX and brax are imported late, when something uses them."""
    assert "brax" in imported["training"]
    assert not imported["training"] & {"scipy.optimize", "scipy.spatial", "trimesh"}
    assert "trimesh" in imported["meshes and contacts"]


def test_what_a_view_shows_needs_no_viser(imported):
    assert {f"mimic.viewer.{name}" for name in SHOWN} <= imported["everything"]


def test_the_start_of_the_process_is_on_the_clock_of_perf_counter(monkeypatch):
    """10 s before now, where the clock since boot says 1000 s and the process started at 990 s."""
    ticks = 990 * os.sysconf("SC_CLK_TCK")
    monkeypatch.setattr(cli, "read_text", lambda path: f"7 (a) name) {'0 ' * 19}{ticks} 0")
    monkeypatch.setattr(cli.time, "clock_gettime", lambda clock: 1000.0)
    monkeypatch.setattr(cli.time, "perf_counter", lambda: 50.0)
    assert cli.process_started() == 40.0
