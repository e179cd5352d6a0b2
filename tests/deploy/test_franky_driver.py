"""The driver of a Franka arm, against an imitation of franky-control's interface."""

import dataclasses
import sys
import types
from typing import Any

import numpy as np
import pytest

from mimic.deploy.driver import RobotAbort
from mimic.deploy.franky_driver import COLLISION_FORCE, COLLISION_TORQUE, FrankyDriver
from mimic.deploy.runner import run_controller
from tests.helpers import bundles


def vector(values):
    values = np.asarray(values, float)
    if values.shape != (7,):
        raise TypeError("incompatible function arguments")
    return values


class Duration:
    def __init__(self, milliseconds=0):
        if not isinstance(milliseconds, int):
            raise TypeError("incompatible constructor arguments")
        self.seconds = milliseconds / 1000


class JointState:
    def __init__(self, position, velocity=(0.0,) * 7):
        self.position, self.velocity = vector(position), vector(velocity)


@dataclasses.dataclass
class JointWaypoint:
    target: JointState
    reference_type: str = "Absolute"
    relative_dynamics_factor: float = 1.0
    minimum_time: Duration | None = None
    hold_target_duration: Duration | None = None
    max_total_duration: Duration | None = None

    def __post_init__(self):
        assert isinstance(self.target, JointState)


class JointWaypointMotion:
    def __init__(self, waypoints, relative_dynamics_factor=1.0, return_when_finished=True):
        assert np.all(waypoints[-1].target.velocity == 0), "the last waypoint must be a stop"
        self.waypoints, self.return_when_finished, self.is_used = waypoints, return_when_finished, False


class JointStopMotion:
    is_used = False


class Limit:
    def __init__(self, maximum, robot):
        self.max, self._robot, self.value = vector(maximum), robot, vector(maximum)

    def set(self, value):
        if self._robot.is_in_control:
            raise RuntimeError("cannot be set while the robot is in control")
        if np.any(vector(value) > self.max):
            raise RuntimeError("exceeds the maximum")
        self.value = vector(value)


def library(qpos, fail_at=None):
    """A module with the part of franky that the driver uses; its robot is the clock of a run."""
    module: Any = types.ModuleType("franky")
    names = ["ControlException", "CommandException", "NetworkException", "ProtocolException", "RealtimeException",
             "IncompatibleVersionException", "InvalidOperationException", "InvalidMotionTypeException",
             "MotionReuseException"]  # fmt: skip
    for name in names:
        setattr(module, name, type(name, (Exception,), {}))

    class Robot:
        def __init__(self, fci_hostname):
            if fci_hostname == "nowhere":
                raise module.NetworkException("libfranka: Connection\ntimeout")
            self.time, self._begun, self._qpos, self._motion, self._error = 0.0, 0.0, np.array(qpos), None, None
            self.moves: list[Any] = []
            self.joint_velocity_limit = Limit([2.0] * 7, self)
            self.joint_acceleration_limit, self.joint_jerk_limit = Limit([100.0] * 7, self), Limit([1e5] * 7, self)
            module.robot = self

        def set_collision_behavior(self, torque_thresholds, force_thresholds):
            self.thresholds = torque_thresholds, force_thresholds

        @property
        def is_in_control(self):
            return self._motion is not None

        def poll_motion(self):
            if self._error is not None:
                error, self._error, self._motion = self._error, None, None
                raise error
            return self.is_in_control

        def join_motion(self, timeout=None):
            assert self._motion is None or isinstance(self._motion, JointStopMotion), "it would wait for ever"
            self._motion = None
            return not self.poll_motion()

        def move(self, motion, asynchronous=False):
            self.poll_motion()
            if motion.is_used:
                raise module.MotionReuseException("a motion must not be reused")
            assert asynchronous, "it would wait for the end of the motion"
            self._qpos, self._begun = self.state.q, self.time
            self._motion, motion.is_used = motion, True
            self.moves.append(motion)
            if len(self.moves) == fail_at:
                self._error = module.ControlException('motion aborted by reflex! ["joint_reflex"]')

        @property
        def state(self):
            """On a line to the first waypoint, and then at the last one."""
            if not isinstance(self._motion, JointWaypointMotion):
                return types.SimpleNamespace(q=self._qpos, dq=np.zeros(7))
            end, stop = self._motion.waypoints
            fraction = (self.time - self._begun) / end.minimum_time.seconds
            if fraction > 1 + 1e-9:
                return types.SimpleNamespace(q=stop.target.position, dq=np.zeros(7))
            return types.SimpleNamespace(
                q=self._qpos + fraction * (end.target.position - self._qpos), dq=end.target.velocity
            )

        def wait_until(self, due):
            self.time = max(self.time, due)
            return self.time

    module.Robot, module.Duration, module.JointState = Robot, Duration, JointState
    module.JointWaypoint, module.JointWaypointMotion = JointWaypoint, JointWaypointMotion
    module.JointStopMotion = JointStopMotion
    return module


@pytest.fixture(scope="module")
def bundle(tmp_path_factory):
    return bundles.make_bundle(tmp_path_factory.mktemp("bundles") / "bundle", ticks=10)


def test_a_motion_is_run(bundle, monkeypatch):
    """Each motion goes to the end of its command's path, and without another command to the stop that was checked."""
    module = library(bundle.start_pose)
    driver = FrankyDriver("192.0.2.1", bundle, library=module)
    robot, commands, write = module.robot, [], driver.write

    def note(command):
        commands.append(command)
        write(command)

    monkeypatch.setattr(driver, "write", note)
    report = run_controller(driver, bundle, clock=robot)
    assert report.is_complete and report.ticks == 10 and not robot.is_in_control
    *motions, last = robot.moves
    assert isinstance(last, JointStopMotion) and not any(motion.return_when_finished for motion in motions)
    assert robot.thresholds == (list(COLLISION_TORQUE), list(COLLISION_FORCE))
    np.testing.assert_array_equal(robot.joint_velocity_limit.value, np.minimum(bundle.parameters.velocity, 2.0))
    np.testing.assert_array_equal(robot.joint_acceleration_limit.value, bundle.limits.acceleration)
    np.testing.assert_array_equal(
        robot.joint_jerk_limit.value, np.minimum(bundle.limits.jerk, 8 * bundle.parameters.jerk)
    )
    ends = [motion.waypoints[0] for motion in motions]
    assert {end.minimum_time.seconds for end in ends} == {0.05}
    positions = np.array([end.target.position for end in ends])
    assert np.ptp(positions, axis=0).min() > 0.02 and np.abs(ends[5].target.velocity).max() > 0.1
    np.testing.assert_array_equal(positions[-1], motions[9].waypoints[1].target.position)  # it stops where it must
    for command, motion in zip(commands, motions, strict=True):
        end, stop = motion.waypoints
        np.testing.assert_array_equal([end.target.position, end.target.velocity], [command.qpos, command.qvel])
        np.testing.assert_array_equal(stop.target.position, command.stop)


def test_a_reflex_is_an_abort_with_its_reason(bundle):
    module = library(bundle.start_pose, fail_at=5)
    report = run_controller(FrankyDriver("192.0.2.1", bundle, library=module), bundle, clock=module.robot)
    assert report.aborted and report.cause == 'motion aborted by reflex! ["joint_reflex"]' and report.ticks == 5


def test_a_robot_that_cannot_be_reached_is_an_abort(bundle):
    with pytest.raises(RobotAbort, match="libfranka: Connection timeout"):
        FrankyDriver("nowhere", bundle, library=library(bundle.start_pose))


def test_a_bundle_that_does_not_fit_is_rejected(bundle):
    module = library(bundle.start_pose)
    with pytest.raises(ValueError, match="expected a bundle with 7 joints, got 6"):
        FrankyDriver("192.0.2.1", dataclasses.replace(bundle, joint_names=("a",) * 6), library=module)


def test_the_package_is_imported_late(bundle, monkeypatch):
    monkeypatch.setitem(sys.modules, "franky", None)
    with pytest.raises(ValueError, match="franky: expected the package franky-control"):
        FrankyDriver("192.0.2.1", bundle)
