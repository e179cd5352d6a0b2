"""Runs on a fake robot: a whole motion, without JAX and MuJoCo, and what happens where something goes wrong."""

import json
import os
import signal
import subprocess
import sys
import textwrap
from types import SimpleNamespace

import numpy as np
import pytest

from mimic.deploy import runner
from mimic.deploy.driver import RobotAbort
from mimic.deploy.fake_robot import FakeRobot
from mimic.deploy.runner import run_controller
from mimic.deploy.safety import COLLISION, INVALID, LATE
from tests.helpers import bundles
from tests.helpers.repository import REPOSITORY

TICKS = bundles.TICKS


@pytest.fixture(scope="module")
def bundle(tmp_path_factory):
    return bundles.make_bundle(tmp_path_factory.mktemp("bundles") / "bundle")


def trace(fake):
    """Angles and velocities of a fake robot after each step of 10 ms."""
    return (np.array([getattr(state, name) for state in fake.states]) for name in ("qpos", "qvel"))


class Constant:
    """A policy that gives a number to all joints, or what a tick has instead, and notes what it observes."""

    def __init__(self, number=0.3, other=None):
        self._number, self._other, self.observed = number, other or {}, []

    def act(self, tick, qpos, qvel, reference):
        self.observed.append((tick, qpos[0], qvel[0], reference))
        return np.full((1, 7), self._other.get(tick, self._number))


def run(bundle, policy=None, robot=None, **options):
    robot = robot or FakeRobot(bundle.start_pose, bundle.limits)
    return run_controller(robot, bundle, policy=policy, clock=robot, **options), robot


def test_a_motion_is_run_until_the_arm_is_at_rest(bundle):
    report, fake = run(bundle, motion="motion 1")
    qpos, qvel = trace(fake)
    assert report.is_complete and not report.aborted and report.ticks == TICKS
    assert not any(report.interventions.values()) and report.tracking_error == 0
    assert np.ptp(qpos, axis=0).min() > 0.1  # every joint moved
    assert np.all(qvel[-1] == 0) and report.clearance > 0.02
    assert json.loads(json.dumps(report.as_dict()))["is_complete"] and report.latency == pytest.approx(0.02)


def test_the_policy_observes_state_and_reference_of_its_tick(bundle):
    """The fake robot is where its reference is: both are the same at each tick."""
    policy = Constant()
    _, fake = run(bundle, policy)
    qpos, qvel = trace(fake)
    assert [tick for tick, *_ in policy.observed] == list(range(TICKS))
    for tick, measured, speed, reference in policy.observed:
        np.testing.assert_array_equal(measured, qpos[5 * tick])
        np.testing.assert_array_equal(speed, qvel[5 * tick])
        np.testing.assert_array_equal(reference.qpos[0], measured)
        np.testing.assert_array_equal(reference.qvel[0], speed)
    assert np.abs(policy.observed[5][2]).max() > 0.1


def test_an_action_acts_20_ms_after_its_state(bundle):
    _, fake = run(bundle, Constant())
    _, qvel = trace(fake)
    moves = np.abs(qvel).max(axis=1) > 0
    assert int(np.argmax(moves)) == 3  # the first sample after 20 ms


def test_the_runtime_needs_neither_jax_nor_mujoco(bundle):
    """A whole motion where imports of all other packages fail."""
    code = """
        import sys
        class Block:
            def find_spec(self, name, path=None, target=None):
                if name.partition(".")[0] in ("jax", "jaxlib", "mujoco", "brax", "mink", "flax", "optax", "omegaconf"):
                    raise ImportError(f"blocked: {name}")
        sys.meta_path.insert(0, Block())
        import mimic.deploy, mimic.deploy.franky_driver
        bundle = mimic.deploy.load_bundle(sys.argv[1])
        robot = mimic.deploy.FakeRobot(bundle.start_pose, bundle.limits)
        report = mimic.deploy.run_controller(robot, bundle, clock=robot)
        assert report.ticks == bundle.ticks and report.is_complete, report
        assert max(abs(state.qpos - bundle.start_pose).max() for state in robot.states) > 0.05
        blocked = {"jax", "mujoco", "brax", "scipy", "hydra"} & {name.partition(".")[0] for name in sys.modules}
        assert not blocked, blocked
    """
    command = [sys.executable, "-c", textwrap.dedent(code), str(bundle.folder)]
    environment = {**os.environ, "PYTHONPATH": str(REPOSITORY)}
    result = subprocess.run(command, capture_output=True, text=True, check=False, cwd="/", env=environment)
    assert result.returncode == 0, result.stderr[-2000:]


class Busy(FakeRobot):
    """A robot with a computer that pauses once for some seconds from a time on."""

    def __init__(self, bundle, at, pause):
        super().__init__(bundle.start_pose, bundle.limits)
        self._at, self._pause = at, pause

    def wait_until(self, due):
        if due >= self._at > 0:
            due, self._at = due + self._pause, 0.0
        return super().wait_until(due)


def test_ticks_that_a_pause_has_passed_are_skipped(bundle):
    """The robot brakes by itself meanwhile, and goes on from there."""
    policy, fake = Constant(), Busy(bundle, 0.5, 0.13)
    report, _ = run(bundle, policy, fake)
    ticks = [tick for tick, *_ in policy.observed]
    assert ticks == [tick for tick in range(TICKS) if tick not in (10, 11)]
    assert report.interventions[LATE] == 2 and not report.is_complete and not report.cause
    _, qvel = trace(fake)
    assert np.abs(qvel[47]).max() > 0.3 and np.abs(qvel[100]).max() > 0.3 and np.all(qvel[-1] == 0)


def test_a_command_that_is_late_is_reported(bundle):
    report, _ = run(bundle, Constant(), Busy(bundle, 0.51, 0.012))  # between a measurement and its command
    assert report.latency == pytest.approx(0.04) and report.interventions[LATE] == 0


@pytest.fixture
def _sigint():
    """Python's handler: what runs the tests may ignore the signal, as a shell in the background does."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


@pytest.mark.usefixtures("_sigint")
@pytest.mark.parametrize("interrupts", [(10,), (10, 11)], ids=["once", "twice"])
def test_ctrl_c_makes_the_arm_brake_before_the_driver_is_stopped(bundle, interrupts):
    """A second one stops the driver at once."""
    reads, events = [], []

    class Interrupted(FakeRobot):
        def read(self):
            reads.append(self.time)
            if len(reads) - 1 in interrupts:
                signal.raise_signal(signal.SIGINT)
            return super().read()

        def stop(self):
            events.append("stop")

    fake, before = Interrupted(bundle.start_pose, bundle.limits), signal.getsignal(signal.SIGINT)
    with pytest.raises(KeyboardInterrupt):
        run(bundle, Constant(), fake)
    assert events == ["stop"] and signal.getsignal(signal.SIGINT) is before
    _, qvel = trace(fake)
    assert np.abs(qvel[47]).max() > 0.3 and len(reads) < TICKS
    assert np.all(qvel[-1] == 0) if len(interrupts) == 1 else len(reads) == 12


def test_an_error_while_the_driver_stops_is_raised(bundle):
    class Broken(FakeRobot):
        def stop(self):
            raise OSError("no connection")

    with pytest.raises(OSError, match="no connection"):
        run(bundle, Constant(), Broken(bundle.start_pose + 0.2, bundle.limits))


@pytest.mark.parametrize(("policy", "count"), [(Constant(np.nan), TICKS), (Constant(0.2, {3: np.inf}), 1)])
def test_a_motion_with_invalid_actions_is_not_complete(bundle, policy, count):
    report, _ = run(bundle, policy)
    assert report.interventions[INVALID] == count and not report.is_complete and not report.cause


def test_a_motion_into_the_floor_ends_in_front_of_it(tmp_path):
    bundle = bundles.make_bundle(tmp_path / "down", bundles.constant(0, 1, 0, 0, 0, 0, 0))
    report, _ = run(bundle)
    assert report.interventions[COLLISION] > 10 and report.clearance > 0.01 and not report.cause


def test_an_arm_far_from_the_start_pose_is_not_moved(bundle):
    report, fake = run(bundle, robot=FakeRobot(bundle.start_pose + 0.2, bundle.limits))
    assert report.cause == "start pose" and not fake.commands and report.ticks == 0


def test_an_arm_that_is_stopped_brakes_and_ends(bundle):
    class Drifting(FakeRobot):
        def read(self):
            state = super().read()
            return state if self.time < 0.5 else state._replace(qpos=state.qpos + 0.25)

    report, fake = run(bundle, Constant(), Drifting(bundle.start_pose, bundle.limits))
    _, qvel = trace(fake)
    assert report.cause == "tracking error" and not report.aborted and report.ticks == 11
    assert np.all(qvel[-1] == 0) and len(fake.commands) < TICKS


@pytest.mark.parametrize("method", ["read", "write"])
def test_a_robot_that_aborts_is_reported(bundle, method):
    class Aborting(FakeRobot):
        def _abort(self):
            if self.time > 0.5:
                raise RobotAbort("reflex")

        def read(self):
            if method == "read":
                self._abort()
            return super().read()

        def write(self, command):
            if method == "write":
                self._abort()
            super().write(command)

        def stop(self):
            raise RobotAbort("stopped already")

    report, _ = run(bundle, robot=Aborting(bundle.start_pose, bundle.limits))
    assert report.cause == "reflex" and report.aborted and not report.is_complete


@pytest.mark.parametrize(("qpos", "qvel", "cause"), [(3.0, 0.0, "position"), (0.0, 2.2, "velocity")])
def test_the_fake_robot_aborts_beyond_its_limits(bundle, qpos, qvel, cause):
    fake, state = FakeRobot(bundle.start_pose, bundle.limits), bundle.start_pose.copy()
    state[0] = qpos
    fake.states.append(fake.states[0]._replace(qpos=state, qvel=np.full(7, -qvel)))
    with pytest.raises(RobotAbort, match=f"joint {cause} limit"):
        fake.read()


def test_a_policy_that_is_none_is_an_error(tmp_path):
    bundle = bundles.make_bundle(tmp_path / "bundle")
    (tmp_path / "bundle" / "policy.onnx").write_bytes(b"x")
    with pytest.raises(ValueError, match=r"bundle: policy.onnx: expected an ONNX model"):
        run(bundle)


def test_the_clock_of_the_computer(monkeypatch):
    """It counts from its first call on, waits for what is due, and does not wait for what is late."""
    now, slept = [100.0], []

    def sleep(seconds):
        slept.append(seconds)
        now[0] += seconds + 0.001

    monkeypatch.setattr(runner, "time", SimpleNamespace(perf_counter=lambda: now[0], sleep=sleep))
    clock = runner.WallClock()
    assert clock.wait_until(0.0) == pytest.approx(0.001)
    assert clock.wait_until(0.05) == pytest.approx(0.051)
    now[0] += 0.1
    assert clock.wait_until(0.1) == pytest.approx(0.152) and slept == pytest.approx([0.0, 0.049, 0.0])
