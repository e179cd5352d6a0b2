"""The demo page: its JavaScript computes what JAX computes."""

import importlib.util
import json
import shutil
import subprocess

import jax
import numpy as np
import pytest

import mimic
from mimic.retargeting.pose_baselines import copy_joints
from tests.helpers.metric_cases import random_poses
from tests.helpers.repository import REPOSITORY

DEMO = REPOSITORY / "docs" / "demo"
NODE = shutil.which("node")
POSES = 20
COMPUTE = """
const arms = require(process.argv[1]);
let data;
global.mimicDemo = {add: added => { data = arms.decoded(added); }};
const {script, poses} = JSON.parse(require("fs").readFileSync(0));
eval(script);
console.log(JSON.stringify(poses.map(pose => arms.compare(data, pose))));
"""


def script_of(name):
    """The script with the mapper of an environment, as the site gets it."""
    spec = importlib.util.spec_from_file_location("demo_data", REPOSITORY / "docs" / "demo_data.py")
    assert spec and spec.loader
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return f"mimicDemo.add({json.dumps(module.demo_data(name))});"


@pytest.mark.slow_for("panda4dof")
@pytest.mark.skipif(NODE is None, reason="the JavaScript of the demo needs node")
@pytest.mark.parametrize("name", ["planar4dof", "panda4dof"])
def test_javascript_computes_what_jax_computes(name):
    mapper = mimic.load(name, "pose_mapper")
    model = mapper.function.model  # type: ignore[attr-defined]
    poses = random_poses(mapper.expert, POSES).astype(float)
    computed = in_node(script_of(name), poses)
    with jax.enable_x64(True):
        params = jax.tree.map(lambda x: np.asarray(x, np.float64), mapper.function.params)  # type: ignore[attr-defined]
        answers = np.asarray(jax.jit(jax.vmap(lambda pose: model(params, pose)))(poses))
        distance = jax.jit(jax.vmap(model.distance))
        expected = {"mapper": answers, "copy": copy_joints(mapper.expert, mapper.learner, poses)}
        distances = {key: distance(poses, pose) for key, pose in expected.items()}
    for key, pose in expected.items():
        np.testing.assert_allclose([result[key]["qpos"] for result in computed], pose, atol=1e-5)
        np.testing.assert_allclose(shown_distance(computed, key), distances[key], atol=1e-5)
    assert np.all(shown_distance(computed, "search") <= shown_distance(computed, "mapper") + 1e-9)


def shown_distance(computed, key):
    return np.array([result[key]["distance"] for result in computed])


def in_node(script, poses):
    assert NODE
    inputs = json.dumps({"script": script, "poses": poses.tolist()})
    command = [NODE, "-e", COMPUTE, str(DEMO / "arms.js")]
    process = subprocess.run(command, input=inputs, capture_output=True, text=True, check=False)
    assert process.returncode == 0, process.stderr[-2000:]
    return json.loads(process.stdout)
