"""The learner's controls on a page: which boxes are shown, and which arm is drawn."""

import importlib.util
import socket

import numpy as np
import pytest

if importlib.util.find_spec("viser") is None:
    pytest.skip("needs viser: pip install 'mimic-arms[view]'", allow_module_level=True)

from mimic.arms.arm import ArmConfig, build_arm
from mimic.commands import view_server
from mimic.commands.config import ViewConfig
from mimic.envs import env_config
from mimic.viewer.learner_controls import LearnerControls
from mimic.viewer.live_session import Frame, LiveSession
from mimic.viewer.tracking import Preset

ARMS = {"panda": ArmConfig(), "planar": ArmConfig(model="planar", link_lengths=[0.3, 0.3, 0.3])}
PRESETS = Preset("panda", 0, {}), Preset("bent", 0, {"joint2": 0.5}), Preset("planar", 1, {})


class NoFunctions:
    """A source of functions that never compiles any."""

    def get(self, settings):
        return None

    def is_complete(self, settings):
        return False

    def wait(self, settings):
        raise NotImplementedError

    def finish(self):
        return None


def frame(arm, locked=()):
    angles = [dict.fromkeys(build_arm(config).embodiment.joint_names, 0.1) for config in ARMS.values()]
    return Frame(angles[0], angles[arm], locked, (), (), 0.1, 0.1, np.eye(1), np.eye(1), {}, arm=arm)


@pytest.fixture
def shown():
    """Runs a function with a page, its controls and the session."""

    def run(check):
        with socket.socket() as probe:
            probe.bind(("127.0.0.1", 0))
            config = ViewConfig(env=env_config("panda7dof"), port=probe.getsockname()[1])
        done = []

        def show(page, times):
            session = LiveSession(config.env, any_arm=NoFunctions())
            controls = LearnerControls(session, page.starts, PRESETS)
            controls.add_widgets(page.server)
            check(page, controls, session)
            done.append(True)

        assert view_server.serve(config, config.env, "arms", show, learners=ARMS) == 0 and done

    return run


def visible(controls):
    return [[name for name, box in boxes.items() if box.visible] for boxes in controls._locks]


def test_the_boxes_are_those_of_the_chosen_arm(shown):
    def check(page, controls, session):
        assert list(map(len, visible(controls))) == [7, 0]
        controls._lock("joint3", True)
        assert controls._locks[0]["joint3"].value and "joint3 at 0.00 rad" in controls._note.content
        assert controls._arm.value == "panda"  # with locks of its own
        controls._choose("bent")
        assert [name for name, box in controls._locks[0].items() if box.value] == ["joint2"]
        assert controls._arm.value == "bent" and "joint2 at 0.50 rad" in controls._note.content
        controls._choose("planar")
        assert list(map(len, visible(controls))) == [0, 3] and session.settings.arm == 1
        assert "locked where it is" in controls._note.content

    shown(check)


def test_one_learner_is_drawn_with_the_marks_of_its_locks(shown):
    def check(page, *_):
        for arm, locked in ((0, ()), (1, ()), (0, ("joint4",))):
            page.move(frame(arm, locked))
            assert [learner._arm.root.visible for learner in page._learners] == [arm == 0, arm == 1]
            marks = {name for name, mark in page._learners[0]._arm._marks.items() if mark.visible}
            assert marks == set(locked)

    shown(check)
