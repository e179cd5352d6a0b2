"""`python -m mimic.view`: what it rejects, and how it ends."""

import contextlib
import importlib.util
import itertools
import signal
import socket
import subprocess
import sys
import threading
import time

import numpy as np
import pytest

from mimic.arms.arm import build_arm
from mimic.commands import view_capture, view_server
from mimic.commands.capture import fixed_fraction
from mimic.commands.config import ViewConfig
from mimic.commands.view_capture import hand_expert, listen, wait_for_arm
from mimic.envs import env_config
from mimic.motions.mocap.live_hand import LiveHand
from mimic.motions.mocap.live_points import Sample, sample_line
from mimic.runs.signals import Signals
from tests.helpers.bodies import bvh_text, person
from tests.helpers.commands import free_port


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["host=nowhere.invalid"], "host: expected an address of this machine"),
        (["learner=missing.xml"], "no MJCF or URDF file at"),
        (["mapper=missing"], "mapper: expected a run directory, which has a config.yaml, or one of panda3dof, "),
        (["run=a", "mapper=b"], "expected one of them"),
        (["mapper=planar4dof", "expert=panda"], "expert: expected none with mapper=, which brings its own"),
        (["run=a", "learner=panda"], "learner: expected none with run=, which brings its own"),
        (["run=a", "env=panda3dof"], "env: expected none with run=, which brings its own"),
        (["mapper=planar4dof", "learner=panda4dof"], "learner: expected none with mapper=, which brings its"),
        (["mapper=planar4dof", "learner.locked=[3]"], "learner: expected none with mapper="),
        (["mapper=planar4dof", "env=panda4dof"], "env: expected none with mapper=, which brings its own"),
        (["source=a.bvh", "expert=panda"], "expert: expected none with source=, which brings its own"),
        (["mapper=planar4dof", "checkpoint=5"], "checkpoint: expected one of 1966080, the steps that"),
        (["hand=near"], "hand: expected one of free, exact, relative, got 'near'"),
        (["hand=exact", "mapper=planar4dof"], "hand: expected none with run= or mapper=, which move the"),
        (["base=[0,0,0,1]"], "base: expected same or [x,y,z,yaw] with hand=exact or relative"),
        (["demonstrations=a.npz", "run=b"], "demonstrations: expected none with run="),
        (["demonstrations=missing.npz"], "missing.npz"),
        (["capture.yaw=3"], "capture: expected none without source="),
        (["source=a.bvh", "arm=middle"], "arm: expected one of left, right, got 'middle'"),
        (["source=a.bvh", "capture.overlap=0.1"], "capture.overlap: expected none with this source of a view"),
        (["source=tcp://localhost"], "source: expected a file or tcp://localhost:PORT"),
        (["source=tcp://localhost:9000", "capture.slow_down=2"], "capture.slow_down: expected none with this source"),
        (["source=tcp://0.0.0.0:9000"], "to take points from other machines, set host=0.0.0.0 too"),
    ],
)
def test_bad_input(reason, arguments, message):
    assert message in reason("view", *arguments, f"port={free_port()}")


def test_bad_input_of_the_command(rejected):
    assert "port: expected a whole number from 1 to 65,535, got 0" in rejected("view", "port=0")


def test_a_port_that_is_taken_is_rejected(reason):
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        assert f"port: expected a free port at 127.0.0.1, got {port}" in reason("view", f"port={port}")


def test_the_extra_is_named_where_viser_is_missing(reason, monkeypatch):
    monkeypatch.setitem(sys.modules, "viser", None)  # an ImportError
    assert "pip install 'mimic-arms[view]'" in reason("view")


@pytest.mark.parametrize(
    ("host", "url"),
    [("0.0.0.0", "127.0.0.1"), ("::", "[::1]"), ("::1", "[::1]"), ("node1", "node1")],
)
def test_the_address_can_be_opened(host, url):
    assert view_server.address(host, 8080) == f"http://{url}:8080"


def test_ticks_end_with_a_signal():
    signals = Signals()
    ticks = view_server.ticks(signals)
    assert next(ticks) >= 0
    signals.caught.append(signal.SIGINT)
    assert list(ticks) == []


@pytest.mark.skipif(importlib.util.find_spec("viser") is None, reason="needs viser: pip install 'mimic-arms[view]'")
@pytest.mark.parametrize(("host", "warned"), [("0.0.0.0", True), ("127.0.0.1", False)])
def test_a_view_that_others_can_reach_says_so(host, warned, capsys):
    config = ViewConfig(env=env_config("planar4dof"), host=host, port=free_port())
    shown = []
    assert view_server.serve(config, config.env, "planar", lambda page, times: shown.append(page)) == 0
    output = capsys.readouterr()
    assert shown and f"view: http://127.0.0.1:{config.port}" in output.out and "view: ended\n" in output.out
    assert ("everyone who can reach this machine" in output.err) == warned


@pytest.fixture
def sends():
    """A function that starts to send samples of the generated person to a port, in a thread."""
    started = []

    def start(port, change=lambda sample: sample):
        stop = threading.Event()
        thread = threading.Thread(target=_send, args=(port, stop, change), daemon=True)
        thread.start()
        started.append((stop, thread))

    yield start
    for stop, thread in started:
        stop.set()
        thread.join()


def _send(port, stop, change):
    body = person(30)
    with socket.create_connection(("localhost", port)) as connection, contextlib.suppress(OSError):
        for number in itertools.count():
            sample = Sample(number / 100, dict(zip(body.names, body.positions[number % 30], strict=True)))
            connection.sendall(sample_line(change(sample)))
            if stop.wait(0.005):
                return


def test_the_arm_of_live_points_is_measured(sends):
    config = ViewConfig(env=env_config("panda4dof"), source=f"tcp://localhost:{free_port()}", arm="left")
    with contextlib.closing(listen(config)) as listener:
        sends(listener.port)
        measured = wait_for_arm(listener, config)
    assert measured is not None and not isinstance(measured, LiveHand)
    arm, links = measured
    assert links.names == ("trunk", "upper_arm", "forearm", "hand") and arm.zero is not None
    np.testing.assert_allclose(links.link_lengths[1:], [0.28, 0.25, 0.09], atol=1e-9)
    # As large a part of the chain as the Panda's column, as for demonstrations.
    learner = build_arm(config.env.learner, config.env.limits, config.env.metric.links).embodiment
    assert links.link_lengths[0] / links.chain_length == pytest.approx(fixed_fraction(learner))


def test_poses_of_a_hand_move_the_expert_s():
    config = ViewConfig(env=env_config("panda4dof"), source=f"tcp://localhost:{free_port()}")
    with contextlib.closing(listen(config)) as listener, socket.create_connection(("localhost", listener.port)) as out:
        out.sendall(b'{"time": 0, "hand": {"position": [0, 0, 1], "wxyz": [1, 0, 0, 0]}, "gripper": 0.2}\n')
        hand = wait_for_arm(listener, config)
        assert isinstance(hand, LiveHand) and hand.gripper == 0.2
        assert hand_expert(config.env, listener).env is config.env


def test_points_in_another_unit_are_said_and_not_taken(sends, capsys, monkeypatch):
    config = ViewConfig(env=env_config("panda4dof"), source=f"tcp://localhost:{free_port()}")
    signals = Signals()
    monkeypatch.setattr(view_capture, "Signals", lambda: signals)
    with contextlib.closing(listen(config)) as listener:
        sends(listener.port, lambda sample: Sample(sample.time, {n: 1000 * p for n, p in sample.points.items()}))
        take, taken = listener.take, []

        def stop_after_three():
            if (sample := take()) is not None:
                taken.append(sample)
            if len(taken) == 3:
                signals.caught.append(signal.SIGINT)
            return sample

        monkeypatch.setattr(listener, "take", stop_after_three)
        assert wait_for_arm(listener, config) is None
    error = capsys.readouterr().err
    assert error.count("\n") == 1 and "points: expected metres, got arms 530, 530 long, as an adult's in mm" in error


def test_an_address_of_other_machines_needs_the_host_too():
    with contextlib.closing(listen(ViewConfig(source=f"tcp://0.0.0.0:{free_port()}", host="0.0.0.0"))):
        pass


@pytest.mark.slow
@pytest.mark.timeout(300)
@pytest.mark.skipif(importlib.util.find_spec("viser") is None, reason="needs viser: pip install 'mimic-arms[view]'")
def test_a_clip_and_live_points_move_the_learner(tmp_path, sends):
    """The whole command: the clip is played, then points arrive and stop."""
    (tmp_path / "clip.bvh").write_text(bvh_text(120))
    port = free_port()
    for source in (str(tmp_path / "clip.bvh"), f"tcp://localhost:{port}"):
        command = [sys.executable, "-m", "mimic.view", f"source={source}", "learner=panda", f"port={free_port()}"]
        process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
        assert process.stdout is not None
        first = process.stdout.readline()
        assert "right_arm: " in first or "waiting for points at tcp://localhost" in first
        if "waiting" in first:
            sends(port)
        assert "view: http://127.0.0.1:" in process.stdout.readline()
        time.sleep(1)
        process.send_signal(signal.SIGINT)
        out, error = process.communicate(timeout=200)
        assert process.returncode == 0 and "Traceback" not in error and "view: ended" in out
        assert ("samples" in out) == ("waiting" in first)
