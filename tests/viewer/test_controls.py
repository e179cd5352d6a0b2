"""The controls of a live view on a page: which joints are locked, and what is drawn of it."""

import importlib.util
from types import SimpleNamespace

import numpy as np
import pytest

if importlib.util.find_spec("viser") is None:
    pytest.skip("needs viser: pip install 'mimic-arms[view]'", allow_module_level=True)

from mimic.commands import view_server
from mimic.commands.config import ViewConfig
from mimic.envs import env_config
from mimic.viewer.controls import LiveControls
from mimic.viewer.live_session import Frame, LiveSession
from mimic.viewer.manual_controls import ManualControls
from mimic.viewer.timeline import TimeControls, Timeline
from tests.helpers.commands import free_port


@pytest.fixture
def serve():
    """Shows something on a page of the environment panda4dof, to the end."""
    config, done = ViewConfig(env=env_config("panda4dof"), port=free_port()), []

    def serve_once(show):
        def show_once(page, times):
            show(page, config)
            done.append(True)

        assert view_server.serve(config, config.env, "arms", show_once) == 0 and done

    return serve_once


def test_locked_joints_are_checked_named_and_marked(serve):
    def show(page, config):
        session = LiveSession(config.env)
        controls = LiveControls(page.server, session, config.env, ManualControls(session, config.env))
        checked = [name for name, box in controls._locks.items() if box.value]
        assert len(controls._locks) == 7 and checked == ["joint3", "joint6", "joint7"]
        controls._lock("joint3", False)
        assert not controls._locks["joint3"].value
        assert controls._note.content == "Locked: joint6 at 0.00 rad, joint7 at 0.00 rad."
        angles = dict.fromkeys(session.joints, 0.1)
        for locked in ((), ("joint4",)):
            page.move(Frame(angles, angles, locked, (), (), 0.1, 0.1, np.eye(1), np.eye(1), {}))
            assert {name for name, mark in page._learner._marks.items() if mark.visible} == set(locked)

    serve(show)


def test_the_slider_of_a_time_stops_where_the_time_does(serve):
    def show(page, config):
        timeline = Timeline(1.03)
        timeline.repeats = False
        controls = TimeControls(page.server, timeline)

        def play(steps):
            for _ in range(steps):
                timeline.advance(0.02)
                controls.update(0.02)
            return controls._scrub.value

        assert play(100) == 1.03 and not timeline.is_playing and controls._button.label == "play"
        controls._set_playing(True)
        play(10)
        controls._set_playing(False)
        assert play(1) == 0.2
        controls._scrubbed(SimpleNamespace(client=object(), target=SimpleNamespace(value=0.5)))
        assert timeline.time == 0.5 and play(1) == 0.2  # the browser moved it itself

    serve(show)
