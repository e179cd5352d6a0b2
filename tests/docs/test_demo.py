"""The demo page: its JavaScript computes what JAX computes, and the page answers to its sliders in a browser."""

import importlib.util
import json
import re
import shutil
import subprocess

import jax
import numpy as np
import pytest

import mimic
from mimic.retargeting.pose_baselines import copy_joints
from mimic.trainers.pretrained.network import names_of_one_learner
from tests.helpers.repository import REPOSITORY

DEMO = REPOSITORY / "docs" / "demo"
NODE = shutil.which("node")
BROWSER = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
POSES = 20
COMPUTE = """
const arms = require(process.argv[1]);
let data;
global.mimicDemo = {add: added => { data = arms.decoded(added); }};
const {script, poses} = JSON.parse(require("fs").readFileSync(0));
eval(script);
console.log(JSON.stringify(poses.map(pose => arms.compare(data, pose))));
"""

needs_node = pytest.mark.skipif(NODE is None, reason="the JavaScript of the demo needs node")
needs_browser = pytest.mark.skipif(BROWSER is None, reason="the demo page needs chromium")


@pytest.fixture(scope="module")
def scripts():
    """The scripts that the site gets, by name."""
    spec = importlib.util.spec_from_file_location("demo_data", REPOSITORY / "docs" / "demo_data.py")
    assert spec and spec.loader
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module.scripts()


def quick(names):
    """Names as parameters; those of one environment run in `make test`."""
    return [pytest.param(name, marks=() if name == "planar4dof" else pytest.mark.slow) for name in names]


@needs_node
@pytest.mark.parametrize("name", quick(names_of_one_learner("pose_mapper")))
def test_javascript_computes_what_jax_computes(name, scripts):
    mapper = mimic.load(name, "pose_mapper")
    model = mapper.function.model  # type: ignore[attr-defined]
    poses = random_poses(mapper.expert)
    computed = in_node(scripts[name], poses)
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


@needs_node
@pytest.mark.slow
def test_the_search_finds_the_optimum(scripts):
    mapper = mimic.load("planar4dof", "pose_mapper")
    poses = random_poses(mapper.expert).astype(np.float32)
    metric = mapper.function.model.built_metric  # type: ignore[attr-defined]
    optimum = mimic.imitate_pose(mapper.expert, mapper.learner, poses, **metric.arguments)
    difference = shown_distance(in_node(scripts["planar4dof"], poses), "search") - np.asarray(optimum.distance)
    # A search of one joint at a time may end at a kink or in another minimum than that of 13 initial guesses.
    assert difference.mean() < 0.01


def random_poses(arm):
    lower, upper = np.asarray(arm.joint_range).T
    return np.random.default_rng(0).uniform(lower, upper, (POSES, len(lower)))


def shown_distance(computed, key):
    return np.array([result[key]["distance"] for result in computed])


def in_node(script, poses):
    assert NODE
    inputs = json.dumps({"script": script, "poses": poses.tolist()})
    command = [NODE, "-e", COMPUTE, str(DEMO / "arms.js")]
    process = subprocess.run(command, input=inputs, capture_output=True, text=True, check=False)
    assert process.returncode == 0, process.stderr[-2000:]
    return json.loads(process.stdout)


STEPS = """
<script>
const until = (condition, then) => condition() ? then() : setTimeout(() => until(condition, then), 50);
const distance = () => mimicDemo.result()?.mapper.distance;
addEventListener("error", event => { document.title = "error: " + event.message; });
until(distance, () => {
  const before = distance(), slider = document.querySelectorAll("#mimic-demo input")[1];
  slider.value = -0.9;
  slider.dispatchEvent(new Event("input"));
  until(() => distance() !== before, () => {
    const canvas = document.querySelector("#mimic-demo canvas");
    const pixels = canvas.getContext("2d").getImageData(0, 0, canvas.width, canvas.height).data;
    const colours = new Set();
    for (let i = 0; i < pixels.length; i += 4) colours.add(pixels.slice(i, i + 3).join());
    document.title = JSON.stringify({before, after: distance(), colours: colours.size, hash: location.hash,
      cell: document.querySelector("[data-name=mapper]").innerText});
  });
});
</script>
"""


@pytest.fixture
def page(scripts, tmp_path):
    """The page's scripts in an empty page, on the disk."""
    for path in DEMO.iterdir():
        shutil.copy(path, tmp_path)
    for name, script in scripts.items():
        (tmp_path / f"{name}.js").write_text(script)
    html = (REPOSITORY / "docs" / "demo.md").read_text()
    tags = re.findall(r"^<(?:link|div|script).*$", html, re.MULTILINE)
    assert len(tags) >= 6
    (tmp_path / "page.html").write_text("<!doctype html>" + "\n".join(tags).replace("demo/", "") + STEPS)
    return tmp_path / "page.html"


@needs_browser
@pytest.mark.timeout(600)  # a browser takes a minute to start on a busy machine
def test_the_page_answers_to_its_sliders(page, tmp_path):
    start = [0.1, 0.2, 0.3, -0.4, 0.5, 0.6, -0.7]
    found = in_browser(f"{page.as_uri()}#planar4dof={','.join(map(str, start))}", tmp_path)
    pose = [start[0], -0.9, *start[2:]]
    mapper = mimic.load("planar4dof", "pose_mapper")
    distance = jax.jit(mapper.function.model.distance)  # type: ignore[attr-defined]
    for expert_pose, shown in ((start, found["before"]), (pose, found["after"])):
        qpos = np.asarray(expert_pose, np.float32)
        assert shown == pytest.approx(float(distance(qpos, mapper(qpos))), abs=1e-5)
    assert found["cell"].split()[-1] == f"{found['after']:.4f}"
    assert found["colours"] > 10  # links of both arms
    assert found["hash"].startswith("#planar4dof=0.1000,-0.9000,")


def in_browser(address, folder):
    """What the steps on a page found: the page's title."""
    assert BROWSER
    options = ["--headless", "--no-sandbox", "--disable-gpu", "--virtual-time-budget=20000", "--dump-dom"]
    command = [BROWSER, *options, f"--user-data-dir={folder}/browser", address]
    process = subprocess.run(command, capture_output=True, text=True, check=False)
    title = re.search(r"<title>(\{.*?\})</title>", process.stdout)
    assert title, re.findall(r"<title>.*?</title>", process.stdout) + [process.stderr[-1000:]]
    return json.loads(title[1])
