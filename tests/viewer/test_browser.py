"""The live view in a headless browser: sliders, playback, and no errors in the console."""

import importlib.util
import io
import re
import shutil
import signal
import subprocess
import sys
import time

import numpy as np
import pytest
from PIL import Image

from mimic.envs import env_config
from mimic.trainers import run_training as train
from mimic.trainers.config import PPOConfig, TrainConfig
from tests.helpers.commands import free_port

BROWSER = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
MISSING = [name for name in ("viser", "playwright") if importlib.util.find_spec(name) is None]
MISSING += [] if BROWSER else ["chromium"]
SOFTWARE_GL = ["--no-sandbox", "--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]
LEARNER = (500, 250, 960, 650)  # pixels of the page where it stands
LATEST = 120_000  # ms for anything, on a busy machine: the kinematic bound has to be compiled

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(bool(MISSING), reason=f"the browser test needs {', '.join(MISSING)}"),
]


@pytest.fixture
def page():
    """A page of a headless browser, and the errors in its console."""
    from playwright.sync_api import sync_playwright  # pyright: ignore[reportMissingImports]

    complaints = []
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=BROWSER, args=SOFTWARE_GL)
        page = browser.new_page(viewport={"width": 1360, "height": 850})
        page.set_default_timeout(LATEST)  # a screenshot waits for a frame, which takes seconds without a GPU
        page.on("console", lambda message: complaints.append(message.text) if message.type == "error" else None)
        page.on("pageerror", lambda error: complaints.append(str(error)))
        yield page, complaints
        browser.close()


@pytest.fixture
def serve():
    """A function that starts the view and returns its address; the view must end with exit code 0."""
    started = []

    def start(*arguments):
        command = [sys.executable, "-m", "mimic.view", f"port={free_port()}", *arguments]
        process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
        started.append(process)
        assert process.stdout is not None
        addresses = (re.search(r"http://\S+", line) for line in process.stdout)
        return next(address.group() for address in addresses if address)

    yield start
    for process in started:
        process.send_signal(signal.SIGINT)
        assert process.wait(timeout=120) == 0


def number(page, name):
    return float(page.inner_text(f"#mimic-{name}"))


def pixels(page):
    return np.asarray(Image.open(io.BytesIO(page.screenshot())).convert("RGB"), float)


def learner_pixels(page):
    left, top, right, bottom = LEARNER
    return pixels(page)[top:bottom, left:right]


def wait_for_bound(page):
    page.wait_for_selector("#mimic-bound", timeout=LATEST)
    page.wait_for_function("!document.querySelector('#mimic-bound').innerText.includes('…')", timeout=LATEST)
    page.wait_for_function("!document.querySelector('#mimic-note').innerText.includes('compiling')", timeout=LATEST)


def updates_per_second(page, seconds):
    """How often the distance on the page changes."""
    count = """async seconds => {
        let last = '', changes = 0; const end = performance.now() + 1000 * seconds;
        while (performance.now() < end) {
            const now = document.querySelector('#mimic-distance').innerText;
            if (now !== last) { changes += 1; last = now; }
            await new Promise(done => setTimeout(done, 2));
        }
        return changes; }"""
    return page.evaluate(count, seconds) / seconds


def test_a_slider_moves_and_the_learner_tracks_it(page, serve, tmp_path):
    page, complaints = page
    page.goto(serve("env=panda4dof"))
    wait_for_bound(page)
    time.sleep(1.0)  # until the learner rests
    before, still = number(page, "distance"), learner_pixels(page)
    page.screenshot(path=tmp_path / "home.png")
    sliders = [page.get_by_role("slider").nth(i) for i in (1, 5)]  # joints 2 and 6; the learner has no joint6
    for slider in sliders:
        slider.focus()
        for _ in range(60):
            slider.press("ArrowRight")
    page.wait_for_function(
        "before => Number(document.querySelector('#mimic-distance').innerText) != before", arg=before, timeout=LATEST
    )
    settled(page)
    page.screenshot(path=tmp_path / "moved.png")
    after, bound = number(page, "distance"), number(page, "bound")
    shown = [float(slider.get_attribute("aria-valuenow")) for slider in sliders]
    assert shown == pytest.approx([0.6, 0.6])  # nothing pulls them back
    assert after != before and 0 <= bound <= after
    assert np.mean(np.abs(learner_pixels(page) - still).max(axis=-1) > 40) > 0.01

    page.get_by_role("tab", name="Metric").click()
    weight = page.get_by_role("slider").first
    weight.focus()
    weight.press("ArrowRight")
    page.wait_for_function(
        "after => Number(document.querySelector('#mimic-distance').innerText) != after", arg=after, timeout=LATEST
    )
    settled(page)
    assert after < number(page, "distance") < 1.06 * after  # one of the weights from 1 to 1.05; 4 digits shown

    page.get_by_role("tab", name="Expert").click()
    page.get_by_text("play", exact=True).click()
    rate = updates_per_second(page, 5.0)
    print(f"updates in the browser while a demonstration plays: {rate:.1f} a second; screenshots: {tmp_path}")
    assert rate > 0  # drawing by the processor is slow, and may be as slow as it likes
    assert not complaints


def settled(page):
    """The distance on the page once it has not changed for two seconds; a busy machine draws one frame a second."""
    until = time.monotonic() + LATEST / 1000
    shown, since = page.inner_text("#mimic-distance"), time.monotonic()
    while time.monotonic() - since < 2:
        assert time.monotonic() < until, "the distance does not come to rest"
        time.sleep(0.1)
        if (now := page.inner_text("#mimic-distance")) != shown:
            shown, since = now, time.monotonic()
    return shown


def test_a_policy_plays_and_can_be_scrubbed(page, serve, tmp_path):
    page, complaints = page
    tiny = {"num_envs": 64, "batch_size": 32, "num_minibatches": 4, "num_updates_per_batch": 1, "hidden_layers": [16]}
    env = env_config("planar4dof", demonstrations={"count": 1, "held_out": 2})
    settings = PPOConfig(**tiny, num_timesteps=2000, evaluations=1)
    config = TrainConfig(env, settings, run_dir=str(tmp_path / "run"), compilation_cache="")
    assert train.prepare_training(config, 0.0)() == 0
    page.goto(serve(f"run={tmp_path / 'run'}"))
    page.wait_for_function("(document.querySelector('#mimic-note')?.innerText ?? '').includes('gap')", timeout=LATEST)
    playing = {page.inner_text("#mimic-distance") for _ in range(20) if not time.sleep(0.1)}
    assert len(playing) > 3
    page.screenshot(path=tmp_path / "playing.png")
    page.get_by_role("button", name="pause").click()
    paused = settled(page)
    scrub = page.get_by_role("slider").first
    scrub.focus()
    for _ in range(12):
        scrub.press("ArrowLeft")
    other = "before => document.querySelector('#mimic-distance').innerText !== before"
    page.wait_for_function(other, arg=paused, timeout=LATEST)
    assert settled(page) != paused
    page.screenshot(path=tmp_path / "scrubbed.png")
    print(f"screenshots: {tmp_path}")
    assert not complaints
