"""Runs on a fake robot: a whole motion, without JAX and MuJoCo, and what happens where the policy dies or stops."""

import json
import os
import pathlib
import signal
import subprocess
import sys
import textwrap
import threading
import time
from typing import cast

import numpy as np
import pytest

from mimic.control.joint_control import Reference
from mimic.deploy.cores import awake_core
from mimic.deploy.driver import RobotAbort
from mimic.deploy.fake_robot import FakeRobot
from mimic.deploy.policy_process import LocalPolicy, PolicyProcess
from mimic.deploy.runner import missed_periods, run_controller
from mimic.deploy.safety import COLLISION, INVALID, LATE, REPEATED, SafetyLayer
from tests.helpers import bundles
from tests.helpers.repository import REPOSITORY


@pytest.fixture(scope="module")
def bundle(tmp_path_factory):
    return bundles.make_bundle(tmp_path_factory.mktemp("bundles") / "bundle")


def robot(bundle, **settings):
    return FakeRobot(bundle.start_pose, bundle.limits, bundle.parameters.inertia, 1.0, **settings)


def trace(fake):
    """Angles, velocities and accelerations of a fake robot."""
    qpos, qvel = (np.array([getattr(state, name) for state in fake.states]) for name in ("qpos", "qvel"))
    return qpos, qvel, np.diff(qvel, axis=0) / 1e-3


def test_a_motion_is_run_in_simulated_time(bundle):
    fake = robot(bundle)
    report = run_controller(fake, bundle, "motion 1", policy=LocalPolicy(bundle, 1))
    qpos, qvel, _ = trace(fake)
    assert report.is_complete and not report.aborted and report.ticks == bundles.TICKS
    assert not any(report.interventions.values()) and report.tracking_error < 0.02
    assert np.ptp(qpos, axis=0).min() > 0.1  # every joint moved
    assert np.abs(qvel[-1]).max() < 1e-3
    assert json.loads(json.dumps(report.as_dict()))["is_complete"]


needs_two_cores = pytest.mark.skipif(
    not hasattr(os, "sched_getaffinity") or len(os.sched_getaffinity(0)) < 2, reason="needs two cores of Linux"
)


@pytest.mark.parametrize("has_own_core", [False, pytest.param(True, marks=needs_two_cores)])
def test_a_policy_in_its_own_process_gives_the_same_actions(tmp_path, has_own_core):
    """Also where it waits for an observation for longer than a tick, and runs the network meanwhile."""
    bundle = bundles.make_bundle(tmp_path / "bundle", bundles.of_all)
    core = max(os.sched_getaffinity(0)) if has_own_core else None
    local, apart, rng = LocalPolicy(bundle, 1), PolicyProcess(bundle, 1, core=core), np.random.default_rng(0)
    try:
        for tick in (0, 1, 2, 5):
            observed = rng.normal(size=(4, 7)).astype(np.float32)
            for policy in (local, apart):
                policy.send(tick, observed[0], observed[1], Reference(observed[2], observed[3], np.zeros(7)))
            end, received = time.monotonic() + 10, None
            while received is None and time.monotonic() < end:
                time.sleep(0.1)
                received = apart.receive()
            expected = local.receive()
            assert received is not None and expected is not None and received[0] == expected[0] == tick
            assert 0.001 < np.abs(received[1]).max() < 1
            np.testing.assert_allclose(received[1], expected[1], atol=1e-6)
    finally:
        apart.close()
    assert len(apart.answer_s) == len(apart.wall_s) == len(apart.cpu_s) == 4 and min(apart.cpu_s) > 0
    assert all(answer > wall for answer, wall in zip(apart.answer_s, apart.wall_s, strict=True))


@pytest.mark.parametrize("size", [16, 16 + 4 * 28 + 1])
def test_an_observation_of_another_size_ends_the_process(bundle, size):
    """Part of the last observation would still be there."""
    policy = PolicyProcess(bundle, 0)
    try:
        policy._socket.send(bytes(size))
        assert policy._process.wait(10) == 1 and policy.receive() is None
    finally:
        policy.close()


def cpu_time(pid):
    """User and system time of a process [s]."""
    fields = pathlib.Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return sum(map(int, fields[11:13])) / os.sysconf("SC_CLK_TCK")


@needs_two_cores
def test_a_policy_with_a_core_of_its_own_keeps_it_busy_and_alone(bundle):
    cores = os.sched_getaffinity(0)
    core, zero = max(cores), np.zeros(7)
    policy = PolicyProcess(bundle, 0, core=core)
    try:
        assert os.sched_getaffinity(policy.pid) == {core} and os.sched_getaffinity(0) == cores - {core}
        before = cpu_time(policy.pid)
        for tick in range(20):
            policy.send(tick, bundle.start_pose, zero, Reference(zero, zero, zero))
            time.sleep(bundle.control_dt)
        # of 0.9; one that shares a core has some 0.2. Another process on the core may take half.
        assert cpu_time(policy.pid) - before > 0.3 * 20 * bundle.control_dt
    finally:
        policy.close()
    assert os.sched_getaffinity(0) == cores


@needs_two_cores
def test_a_core_that_nothing_can_have_is_rejected(bundle, monkeypatch):
    cores = os.sched_getaffinity(0)
    first = min(cores)
    for pair, expected in (
        ((first, 1000), "one that processes may use, got 1000"),
        ((first, -1), "a number of a core, from 0 on, got -1"),
        ((1000, first), rf"one that this thread may use, of \[{first}.*\], got 1000"),
        ((-1, first), "a number of a core, from 0 on, got -1"),
    ):
        with pytest.raises(ValueError, match=f"core: expected {expected}"):
            run_controller(robot(bundle), bundle, cores=pair)
    for cores_given in (0, (0,), (0, 1.0), "01", (True, False)):
        with pytest.raises(ValueError, match=r"cores: expected a pair of core numbers such as \(0, 1\)"):
            run_controller(robot(bundle), bundle, cores=cast("tuple[int, int]", cores_given))
    with pytest.raises(ValueError, match=r"cores: expected None with a given policy, got \(0, 1\)"):
        run_controller(robot(bundle), bundle, policy=LocalPolicy(bundle, 0), cores=(0, 1))
    assert os.sched_getaffinity(0) == cores
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: {0})
    with pytest.raises(ValueError, match="core: expected another core than that of the inner loop, got 0"):
        PolicyProcess(bundle, 0, core=0)


def children():
    """Numbers of the processes that this thread has started and that have not ended."""
    return set(map(int, pathlib.Path("/proc/thread-self/children").read_text().split()))


def status(pid):
    """State of a process, as "R" for running or ready to; "Z" where it has ended."""
    try:
        return pathlib.Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0]
    except FileNotFoundError:
        return "Z"


class Watching(FakeRobot):
    """A fake robot that notes in each read the cores of this thread, and the states of the processes it has started."""

    def __init__(self, *arguments, **settings):
        super().__init__(*arguments, **settings)
        self.before, self.cores, self.seen, self.processes = children(), [], [], {}

    def read(self):
        self.cores.append(os.sched_getaffinity(0))
        self.processes = self.processes or {
            pid: (os.sched_getscheduler(pid), os.sched_getaffinity(pid)) for pid in children() - self.before
        }
        self.seen.append({pid: status(pid) for pid in self.processes})
        return super().read()


@needs_two_cores
@pytest.mark.parametrize("is_shared", [True, False])
def test_the_core_of_the_inner_loop_does_not_halt_during_a_run(bundle, is_shared):
    cores = os.sched_getaffinity(0)
    core = min(cores)
    policy_core = core if is_shared else max(cores)
    fake = Watching(bundle.start_pose, bundle.limits, bundle.parameters.inertia, 1.0, is_paced=True)
    report = run_controller(fake, bundle, cores=(core, policy_core))
    assert report.is_complete
    assert all(used == {core} for used in fake.cores) and os.sched_getaffinity(0) == cores
    (lowest,) = (pid for pid, (scheduler, _) in fake.processes.items() if scheduler == os.SCHED_IDLE)
    (policy,) = fake.processes.keys() - {lowest}
    assert fake.processes[lowest][1] == {core} and fake.processes[policy][1] == {policy_core}
    states = [seen[lowest] for seen in fake.seen]
    assert states.count("R") > 0.5 * len(states)  # it never waits, but for its start
    assert children() == fake.before


@needs_two_cores
def test_cores_are_restored_after_a_run_of_a_policy_with_its_own_core(bundle):
    cores = os.sched_getaffinity(0)
    policy = PolicyProcess(bundle, 0, core=max(cores))
    with awake_core(min(cores)):
        run_controller(robot(bundle), bundle, policy=policy)
    assert os.sched_getaffinity(0) == cores


@needs_two_cores
def test_what_keeps_a_core_awake_ends_with_a_killed_parent():
    code = """
        import os, time
        from mimic.deploy.cores import awake_core
        with awake_core(min(os.sched_getaffinity(0))):
            (child,) = open("/proc/thread-self/children").read().split()
            print(child, flush=True)
            time.sleep(60)
    """
    command = [sys.executable, "-c", textwrap.dedent(code)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True, cwd=REPOSITORY) as process:
        assert process.stdout is not None
        child = process.stdout.readline().strip()
        was = status(child) if child else "Z"
        process.kill()
    assert was != "Z"
    end = time.monotonic() + 20
    while status(child) != "Z" and time.monotonic() < end:
        time.sleep(0.05)
    assert status(child) == "Z"


@pytest.mark.skipif(not hasattr(os, "sched_setscheduler"), reason="Linux only")
def test_the_policy_process_does_not_preempt_the_inner_loop(bundle):
    policy = PolicyProcess(bundle, 0)
    try:
        if os.sched_getscheduler(0) == os.SCHED_OTHER:
            assert os.sched_getscheduler(policy.pid) == os.SCHED_BATCH
        else:
            own, of_policy = os.sched_getparam(0).sched_priority, os.sched_getparam(policy.pid).sched_priority
            assert of_policy == (own - 1 if own > 1 else own)
    finally:
        policy.close()


def test_the_runtime_needs_neither_jax_nor_mujoco(bundle):
    """A whole motion, with the policy in its own process, where imports of all other packages fail."""
    code = """
        import sys
        class Block:
            def find_spec(self, name, path=None, target=None):
                if name.partition(".")[0] in ("jax", "jaxlib", "mujoco", "brax", "mink", "flax", "optax", "omegaconf"):
                    raise ImportError(f"blocked: {name}")
        sys.meta_path.insert(0, Block())
        import mimic.deploy
        bundle = mimic.deploy.load_bundle(sys.argv[1])
        robot = mimic.deploy.FakeRobot(bundle.start_pose, bundle.limits, bundle.parameters.inertia, 1.0, is_paced=True)
        report = mimic.deploy.run_controller(robot, bundle)
        assert report.ticks == bundle.ticks and not report.cause, report
        assert max(abs(state.qpos - bundle.start_pose).max() for state in robot.states) > 0.05
        blocked = {"jax", "mujoco", "brax", "scipy", "hydra"} & {name.partition(".")[0] for name in sys.modules}
        assert not blocked, blocked
    """
    command = [sys.executable, "-c", textwrap.dedent(code), str(bundle.folder)]
    environment = {**os.environ, "PYTHONPATH": str(REPOSITORY)}
    result = subprocess.run(command, capture_output=True, text=True, check=False, cwd="/", env=environment)
    assert result.returncode == 0, result.stderr[-2000:]


def test_controllers_are_exported_where_onnxruntime_is_not_installed():
    code = "import sys; sys.modules['onnxruntime'] = None; import mimic.trainers.export.export, mimic.deploy"
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False, cwd=REPOSITORY)
    assert result.returncode == 0, result.stderr[-2000:]


@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGSTOP])
def test_a_policy_that_dies_or_stops_makes_the_arm_brake_and_hold(tmp_path, number):
    """In real time, in the middle of a fast motion."""
    bundle = bundles.make_bundle(tmp_path / "fast", bundles.constant(0.8, -0.3, 0, 0, 0.8, 0, 0), ticks=60)
    fake, policy = robot(bundle, is_paced=True), PolicyProcess(bundle, 0)

    def end_policy():
        while not fake.states or fake.states[-1].qvel[0] < 1.2:  # not by the clock: a process may take seconds to start
            time.sleep(0.002)
        os.kill(policy.pid, number)

    threading.Thread(target=end_policy, daemon=True).start()
    report = run_controller(fake, bundle, policy=policy)
    qpos, qvel, qacc = trace(fake)
    fastest = int(np.abs(qvel[:, 0]).argmax())
    assert qvel[fastest, 0] > 1.0 and report.interventions[LATE] > 5 and not report.is_complete
    assert not report.aborted and report.interventions[REPEATED] >= 2
    assert np.all(np.abs(qvel[-100:]).max(axis=0) < 1e-2)  # it holds
    assert np.abs(qpos[-1] - qpos[-100]).max() < 1e-3
    assert np.all(np.abs(qacc) < bundle.limits.acceleration + 1)  # 1 rad/s^2: of the tracking error
    assert qvel[fastest:, 0].min() > -0.1  # it brakes, and does not turn round


def test_ctrl_c_does_not_end_the_policy(bundle):
    """It is the inner loop's: a terminal sends it to both processes."""
    policy, zeros = PolicyProcess(bundle, 0), np.zeros(7)
    try:
        os.kill(policy.pid, signal.SIGINT)
        policy.send(0, bundle.start_pose, zeros, Reference(bundle.start_pose, zeros, zeros))
        deadline, answer = time.monotonic() + 30.0, None
        while answer is None and time.monotonic() < deadline:
            answer = policy.receive()
    finally:
        policy.close()
    assert answer is not None and answer[0] == 0


class Scripted:
    """A policy of given answers: {tick: action}; others are missing."""

    def __init__(self, actions):
        self._actions, self._tick = actions, -1

    def send(self, tick, qpos, qvel, reference):
        self._tick = tick

    def receive(self):
        action, tick = self._actions.get(self._tick), self._tick
        return None if action is None else (tick, np.full(7, action))

    def close(self):
        pass


@pytest.fixture
def _sigint():
    """Python's handler: what runs the tests may ignore the signal, as a shell in the background does."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


@pytest.mark.usefixtures("_sigint")
@pytest.mark.parametrize("interrupts", [(500,), (500, 520)], ids=["once", "twice"])
def test_ctrl_c_makes_the_arm_brake_before_the_driver_is_stopped(bundle, interrupts):
    """A second one stops the driver at once."""
    events = []

    class Interrupted(FakeRobot):
        def read(self):
            state = super().read()
            if len(self.states) in interrupts:
                signal.raise_signal(signal.SIGINT)
            return state

        def stop(self):
            events.append("stop")

    class Policy(Scripted):
        def close(self):
            events.append("close")

    fake = Interrupted(bundle.start_pose, bundle.limits, bundle.parameters.inertia, 1.0)
    before = signal.getsignal(signal.SIGINT)
    with pytest.raises(KeyboardInterrupt):
        run_controller(fake, bundle, policy=Policy(dict.fromkeys(range(bundles.TICKS), 0.3)))
    assert events == ["stop", "close"] and signal.getsignal(signal.SIGINT) is before
    _, qvel, qacc = trace(fake)
    assert np.abs(qvel[499]).max() > 0.3 and len(qvel) < bundles.TICKS * bundle.periods
    assert np.all(np.abs(qacc) < bundle.limits.acceleration + 1)  # 1 rad/s^2: of the tracking error
    is_at_rest = np.abs(qvel[-1]).max() < 1e-2
    assert is_at_rest if len(interrupts) == 1 else len(qvel) == interrupts[-1]


def test_the_policy_is_closed_where_the_driver_does_not_stop(bundle):
    class Broken(FakeRobot):
        def stop(self):
            raise OSError("no connection")

    class Policy(Scripted):
        is_closed = False

        def close(self):
            self.is_closed = True

    policy = Policy({})
    with pytest.raises(OSError, match="no connection"):
        run_controller(Broken(bundle.start_pose + 0.2, bundle.limits, bundle.parameters.inertia), bundle, policy=policy)
    assert policy.is_closed


@pytest.mark.parametrize(
    ("actions", "waited"),
    [({}, bundles.TICKS), (dict.fromkeys(range(3, bundles.TICKS), 0.1), 3)],
    ids=["never", "after three ticks"],
)
def test_a_motion_without_actions_at_its_start_is_not_complete(bundle, actions, waited):
    report = run_controller(robot(bundle), bundle, policy=Scripted(actions))
    assert report.waited == waited and not report.is_complete
    assert not report.cause and not any(report.interventions.values())


def test_a_motion_with_invalid_actions_alone_is_not_complete(bundle):
    report = run_controller(robot(bundle), bundle, policy=Scripted(dict.fromkeys(range(bundles.TICKS), np.nan)))
    assert report.interventions[INVALID] == report.waited == bundles.TICKS and not report.is_complete


@pytest.mark.parametrize(
    ("actions", "kind"), [({0: 0.2}, LATE), ({0: 0.2, 1: np.nan}, INVALID)], ids=["no answer", "not a number"]
)
def test_a_policy_without_valid_answers_is_counted(bundle, actions, kind):
    report = run_controller(robot(bundle), bundle, policy=Scripted(actions))
    assert report.interventions[kind] > 0 and not report.is_complete and not report.cause


def test_an_observation_is_sent_after_the_torque_and_has_the_state_before_it(bundle, monkeypatch):
    events, references, period = [], [], SafetyLayer.period

    def noted(layer, qpos, qvel):
        references.append(layer.reference)
        return period(layer, qpos, qvel)

    monkeypatch.setattr(SafetyLayer, "period", noted)

    class Recording(FakeRobot):
        def write(self, torque):
            events.append(("write", None, None))
            super().write(torque)

    class Policy(Scripted):
        def send(self, tick, qpos, qvel, reference):
            events.append(("send", qpos, reference))
            super().send(tick, qpos, qvel, reference)

    fake = Recording(bundle.start_pose, bundle.limits, bundle.parameters.inertia, 1.0)
    report = run_controller(fake, bundle, policy=Policy(dict.fromkeys(range(bundles.TICKS), 0.3)))
    names = [name for name, *_ in events]
    sent = [i for i, name in enumerate(names) if name == "send"]
    assert len(sent) == report.ticks == bundles.TICKS and names[:2] == ["write", "send"]
    assert np.diff(sent).tolist() == [bundle.periods + 1] * (bundles.TICKS - 1)
    states = fake.states[:: bundle.periods][: bundles.TICKS]
    references = references[:: bundle.periods][: bundles.TICKS]
    for i, state, reference in zip(sent, states, references, strict=True):
        np.testing.assert_array_equal(events[i][1], state.qpos)
        np.testing.assert_array_equal(events[i][2], np.array(reference)[:, :, 0])
    assert np.abs(events[sent[5]][2].qvel).max() > 0.1  # the reference moves, and the arm with it


def test_an_action_acts_21_periods_after_its_state(bundle):
    fake = robot(bundle)
    report = run_controller(fake, bundle, policy=Scripted(dict.fromkeys(range(bundles.TICKS), 0.3)))
    moves = [np.abs(state.torque).max() > 0 for state in fake.states]  # a state has the torque of the period before
    assert moves.index(True) == 22 and not any(report.interventions.values())


def test_an_action_after_half_a_tick_is_not_used(bundle):
    """The last one is used again, and the answer is not taken for that of the next tick."""

    class Slow(Scripted):
        def __init__(self):
            super().__init__({})
            self._asked = 0

        def send(self, tick, qpos, qvel, reference):
            super().send(tick, qpos, qvel, reference)
            self._asked = 0

        def receive(self):
            self._asked += 1
            late = self._tick == 3
            if late and self._asked <= 10:
                return None
            return self._tick - late, np.full(7, 0.9 if late else 0.1)

    fake = robot(bundle)
    report = run_controller(fake, bundle, policy=Slow())
    assert report.interventions[REPEATED] == 1 and report.interventions[LATE] == 0
    assert np.abs(trace(fake)[1]).max() < 0.15 * bundle.limits.velocity.max()


def test_times_are_those_of_each_period(bundle):
    report = run_controller(robot(bundle), bundle, policy=LocalPolicy(bundle, 0))
    assert len(report.latency_s) == len(report.wall_s) == len(report.cpu_s) > bundles.TICKS * bundle.periods
    assert all(0 < latency < wall for latency, wall in zip(report.latency_s, report.wall_s, strict=True))
    assert report.latency_ms["p50"] == pytest.approx(1e3 * np.median(report.latency_s))
    assert not any(isinstance(value, list) for value in report.as_dict().values())


def test_actions_of_an_earlier_tick_are_not_used(bundle):
    class Late(Scripted):
        def receive(self):
            return self._tick - 1, np.ones(7)

    fake = robot(bundle)
    run_controller(fake, bundle, policy=Late({}))
    assert np.abs(trace(fake)[1]).max() == 0


def test_a_motion_into_the_floor_ends_in_front_of_it(tmp_path):
    bundle = bundles.make_bundle(tmp_path / "down", bundles.constant(0, 1, 0, 0, 0, 0, 0))
    report = run_controller(robot(bundle), bundle, policy=LocalPolicy(bundle, 0))
    assert report.interventions[COLLISION] > 10 and report.clearance > 0.01 and not report.cause


def test_an_arm_far_from_the_start_pose_is_not_moved(bundle):
    fake = FakeRobot(bundle.start_pose + 0.2, bundle.limits, bundle.parameters.inertia)
    report = run_controller(fake, bundle, policy=LocalPolicy(bundle, 0))
    assert report.cause == "start pose" and len(fake.states) == 1 and report.ticks == 0


def test_a_robot_that_aborts_is_reported(bundle):
    class Aborting(FakeRobot):
        def read(self):
            if len(self.states) > 300:
                raise RobotAbort("reflex")
            return super().read()

    fake = Aborting(bundle.start_pose, bundle.limits, bundle.parameters.inertia)
    report = run_controller(fake, bundle, policy=LocalPolicy(bundle, 0))
    assert report.cause == "reflex" and report.aborted and not report.is_complete


def test_the_fake_robot_aborts_beyond_its_limits(bundle):
    fake = robot(bundle)
    fake.read()
    fake.write(np.full(7, 2.0))
    with pytest.raises(RobotAbort, match="torque rate"):
        fake.read()
    for period in range(3000):
        try:
            fake.write(np.full(7, min(11.0, period)))
            fake.read()
        except RobotAbort as abort:
            assert abort.cause in ("joint velocity limit", "joint position limit")
            return
    pytest.fail("no abort")


def test_a_policy_that_cannot_start_is_an_error(tmp_path):
    bundle = bundles.make_bundle(tmp_path / "bundle")
    (tmp_path / "bundle" / "policy.onnx").write_bytes(b"x")
    started = time.monotonic()
    with pytest.raises(RuntimeError, match="policy: expected its process to be ready"):
        PolicyProcess(bundle, 0)
    assert time.monotonic() - started < 25  # as soon as it has ended


def test_missed_periods_are_counted_by_the_clock(bundle):
    robot = FakeRobot(bundle.start_pose, bundle.limits, bundle.parameters.inertia, 1.0, is_paced=True)
    for period in range(6):
        robot.read()
        robot.write(np.zeros(7))
        time.sleep(0.0045 if period == 3 else 0.0)
    assert missed_periods(robot.states) >= 3
