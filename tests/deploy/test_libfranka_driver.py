"""The driver of a Franka arm, against an imitation of pylibfranka's interface."""

import dataclasses
import sys
import types
from typing import Any

import numpy as np
import pytest

from mimic.deploy.driver import RobotAbort
from mimic.deploy.fake_robot import FakeRobot
from mimic.deploy.libfranka_driver import COLLISION_FORCE, COLLISION_TORQUE, LibfrankaDriver
from mimic.deploy.policy_process import LocalPolicy
from mimic.deploy.runner import run_controller
from tests.helpers import bundles


@dataclasses.dataclass
class Torques:
    tau_J: list[float]  # noqa: N815
    motion_finished: bool = False


@dataclasses.dataclass
class Duration:
    seconds: float

    def to_sec(self):
        return self.seconds


class ActiveControl:
    """Takes one torque after each state, as libfranka does."""

    def __init__(self, owner):
        self._owner, self._is_answered = owner, True

    def readOnce(self):  # noqa: N802
        assert self._is_answered, "read twice"
        self._is_answered = False
        self._owner.check()
        state = self._owner.fake.read()
        fields = {"q": list(state.qpos), "dq": list(state.qvel), "tau_J": list(state.torque)}
        return types.SimpleNamespace(**fields, time=Duration(state.time)), Duration(0.001)

    def writeOnce(self, command):  # noqa: N802
        assert not self._is_answered, "written twice"
        assert isinstance(command, Torques) and len(command.tau_J) == 7
        assert all(type(x) is float for x in command.tau_J)
        self._is_answered = True
        self._owner.commands.append(command)
        if not command.motion_finished:
            self._owner.fake.write(np.array(command.tau_J))


def library(fake, fail_at=None):
    """A module with the part of pylibfranka that the driver uses."""
    module: Any = types.ModuleType("pylibfranka")

    class FrankaException(Exception):
        pass

    class ControlException(RuntimeError):
        pass

    class Robot:
        def __init__(self, address):
            if address == "nowhere":
                raise FrankaException("libfranka: Connection\ntimeout")
            self.fake, self.commands, self.is_stopped = fake, [], False
            module.robot = self

        def set_collision_behavior(self, *thresholds):
            self.thresholds = thresholds

        def start_torque_control(self):
            return ActiveControl(self)

        def stop(self):
            self.is_stopped = True

        def check(self):
            if len(self.commands) == fail_at:
                raise ControlException('motion aborted by reflex! ["joint_reflex"]')

    module.Robot, module.Torques = Robot, Torques
    module.FrankaException, module.ControlException = FrankaException, ControlException
    return module


@pytest.fixture
def bundle(tmp_path):
    return bundles.make_bundle(tmp_path / "bundle", ticks=10)


@pytest.fixture
def fake(bundle):
    return FakeRobot(bundle.start_pose, bundle.limits, bundle.parameters.inertia, 1.0)


def test_a_motion_is_run(bundle, fake):
    module = library(fake)
    driver = LibfrankaDriver("192.0.2.1", library=module)
    report = run_controller(driver, bundle, policy=LocalPolicy(bundle, 0))
    robot = module.robot
    assert report.is_complete and robot.is_stopped
    assert robot.commands[-1].motion_finished and not any(command.motion_finished for command in robot.commands[:-1])
    assert [len(values) for values in robot.thresholds] == [7, 7, 6, 6]
    assert robot.thresholds[0] == list(COLLISION_TORQUE) and robot.thresholds[3] == list(COLLISION_FORCE)
    torque = np.array([command.tau_J for command in robot.commands[:-1]])
    assert np.abs(np.diff(torque, axis=0, prepend=0)).max() <= 1.0 and np.abs(torque).max() > 1


def test_a_reflex_is_an_abort_with_its_reason(bundle, fake):
    driver = LibfrankaDriver("192.0.2.1", library=library(fake, fail_at=200))
    report = run_controller(driver, bundle, policy=LocalPolicy(bundle, 0))
    assert report.aborted and report.cause == 'motion aborted by reflex! ["joint_reflex"]'


def test_a_robot_that_cannot_be_reached_is_an_abort(fake):
    with pytest.raises(RobotAbort, match="libfranka: Connection timeout"):
        LibfrankaDriver("nowhere", library=library(fake))


def test_the_package_is_imported_late(monkeypatch):
    monkeypatch.setitem(sys.modules, "pylibfranka", None)
    with pytest.raises(ValueError, match="libfranka: expected the package pylibfranka"):
        LibfrankaDriver("192.0.2.1")
