"""`python -m mimic.view`: what it rejects, and how it ends."""

import importlib.util
import signal
import socket
import subprocess
import sys

import pytest

from mimic.commands import view
from mimic.commands.config import ViewConfig
from mimic.envs import env_config
from mimic.runs.signals import Signals


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["port=0"], "port: expected a whole number from 1 to 65,535, got 0"),
        (["host=nowhere.invalid"], "host: expected an address of this machine"),
        (["env=panda5dof"], "unknown env 'panda5dof'; valid are"),
        (["learner=missing.xml"], "learner: expected panda, an MJCF file, or an environment (pair, panda3dof,"),
        (["run=missing"], "not a run directory"),
        (["mapper=missing"], "not a run directory"),
        (["run=a", "mapper=b"], "expected one of them"),
        (["run=a", "expert=panda"], "expected neither with run= or mapper="),
        (["follow=true"], "follow: expected with run= and without checkpoint="),
        (["run=a", "follow=true", "checkpoint=5"], "got run='a' and checkpoint=5"),
        (["run=missing", "follow=true"], "not a run directory"),
        (["split=test"], "expected one of train, held_out, got 'test'"),
    ],
)
def test_bad_input(rejected, arguments, message, monkeypatch):
    monkeypatch.setattr(view, "is_installed", lambda: True)
    assert message in rejected("view", *arguments, *([] if "port=0" in arguments else [f"port={free_port()}"]))


def test_a_port_that_is_taken_is_rejected(rejected, monkeypatch):
    monkeypatch.setattr(view, "is_installed", lambda: True)
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        assert f"port: expected a free port at 127.0.0.1, got {port}" in rejected("view", f"port={port}")


def test_the_extra_is_named_where_viser_is_missing(rejected, monkeypatch):
    find = importlib.util.find_spec
    monkeypatch.setattr(importlib.util, "find_spec", lambda name, *more: None if name == "viser" else find(name, *more))
    assert "pip install 'mimic-arms[view]'" in rejected("view")


def test_only_the_page_of_the_view_imports_viser():
    names = "html", "live_session", "playback", "meshes", "follower", "history", "newest_checkpoint"
    code = f"import sys; sys.modules['viser'] = None; import {', '.join(f'mimic.viewer.{name}' for name in names)}"
    subprocess.run([sys.executable, "-c", code], check=True, timeout=60)


def test_arms_can_be_named_by_their_environment():
    arms = ViewConfig(expert="planar4dof", learner="planar4dof").resolve_env()
    assert len(arms.expert.link_lengths) == 7 and len(arms.learner.link_lengths) == 4


@pytest.mark.parametrize(
    ("host", "url"),
    [("127.0.0.1", "127.0.0.1"), ("0.0.0.0", "127.0.0.1"), ("::", "[::1]"), ("::1", "[::1]"), ("node1", "node1")],
)
def test_the_address_can_be_opened(host, url):
    assert view.address(host, 8080) == f"http://{url}:8080"


def test_ticks_end_with_a_signal():
    signals = Signals()
    ticks = view.ticks(signals)
    assert next(ticks) >= 0
    signals.caught.append(signal.SIGINT)
    assert list(ticks) == []


@pytest.mark.skipif(importlib.util.find_spec("viser") is None, reason="needs viser: pip install 'mimic-arms[view]'")
@pytest.mark.parametrize(("host", "warned"), [("0.0.0.0", True), ("127.0.0.1", False)])
def test_a_view_that_others_can_reach_says_so(host, warned, capsys):
    config = ViewConfig(env=env_config("planar4dof"), host=host, port=free_port())
    shown = []
    assert view.serve(config, config.env, lambda page, times: shown.append(page)) == 0
    output = capsys.readouterr()
    assert shown and f"view: http://127.0.0.1:{config.port}" in output.out and "view: ended\n" in output.out
    assert ("everyone who can reach this machine" in output.err) == warned


def free_port():
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


@pytest.mark.slow
@pytest.mark.skipif(importlib.util.find_spec("viser") is None, reason="needs viser: pip install 'mimic-arms[view]'")
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_signals_end_the_command_cleanly(number):
    command = [sys.executable, "-m", "mimic.view", "env=planar4dof", f"port={free_port()}"]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    assert process.stdout is not None
    assert "view: http://127.0.0.1:" in process.stdout.readline()
    process.send_signal(number)  # most likely while it compiles
    out, error = process.communicate(timeout=120)
    assert process.returncode == 0 and "Traceback" not in error and "view: ended" in out
