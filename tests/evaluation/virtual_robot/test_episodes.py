"""Episodes on virtual robots: the safety layer against random actions, delays and losses, and the same as alone."""

import contextlib
import dataclasses
import multiprocessing
import os
from types import SimpleNamespace

import numpy as np
import pytest

from mimic.control.joint_control import Reference
from mimic.deploy.driver import Command
from mimic.deploy.runner import run_controller
from mimic.deploy.safety import COLLISION, LATE, REPEATED, SafetyLayer
from mimic.evaluation.virtual_robot import runs
from mimic.evaluation.virtual_robot.episodes import ABORTED, Channel, SafeController, run_episodes
from mimic.evaluation.virtual_robot.loops import LOOPS
from mimic.evaluation.virtual_robot.robots import FLOOR_CONTACT, TORQUE_RATE, VirtualRobots
from mimic.evaluation.virtual_robot.runs import Task, groups, run_task, run_tasks
from mimic.physics.world import WorldConfig
from tests.helpers import bundles
from tests.helpers.virtual_robots import VirtualRobot, hardware, model, virtual, world

TICKS = 100  # 5 s
LONGEST = 20  # ticks for which a random action is held


class Adversary(SafeController):
    """Random actions in [-1, 1], half of them at the ends, each for 1 to 20 ticks, through the safety layer."""

    def __init__(self, bundle, motion, drawn, robots, loop, seed):
        super().__init__(bundle, motion, drawn, robots, loop, seed=seed, policy=self)
        self._random, self._size = np.random.default_rng(seed), bundle.num_joints
        self._action = np.zeros((len(motion), self._size))
        self._held = np.zeros(len(motion), int)

    def act(self, tick, qpos, qvel, reference):
        rng, robots = self._random, len(self._held)
        action = rng.uniform(-1, 1, self._action.shape)
        action = np.where(rng.uniform(size=(robots, 1)) < 0.5, np.sign(action), action)
        is_new, self._held = self._held <= 1, self._held - 1
        self._action = np.where(is_new[:, None], action, self._action)
        self._held = np.where(is_new, rng.integers(1, LONGEST + 1, robots), self._held)
        return self._action


def adversarial_episodes(folder, mode, episodes, seed, loop="mimic", ticks=TICKS):
    bundle = bundles.make_bundle(folder, bundles.constant(*[0.0] * 7), mode=mode, ticks=ticks)
    drawn, motion = world(hardware(), episodes, seed), np.zeros(episodes, int)
    robots = VirtualRobots(model(), drawn, bundle.start_poses[motion], seed)
    return run_episodes(robots, Adversary(bundle, motion, drawn, robots, loop, seed), motion)


def check_safe(episodes):
    """No abort of the robot, which includes every limit, self-contacts and the floor."""
    assert np.all(episodes.aborts == ""), set(episodes.aborts)
    assert episodes.clearance.min() > 0.01
    assert episodes.interventions[COLLISION].sum() > len(episodes.motion)  # the safety layer had something to do
    moved = np.abs(np.diff(episodes.qpos, axis=1)).sum(axis=1)
    assert moved.mean() > 0.02 * episodes.qpos.shape[1]  # rad: the arms moved


@pytest.mark.slow_for("ruckig")
@pytest.mark.parametrize("loop", LOOPS)
def test_random_actions_are_safe(tmp_path, loop):
    check_safe(adversarial_episodes(tmp_path / "bundle", "joint_velocity", 3, seed=5, loop=loop, ticks=40))


@pytest.mark.slow
@pytest.mark.parametrize(("mode", "loop"), zip(["joint_velocity", "joint_position"], LOOPS, strict=True))
def test_many_random_actions_are_safe(tmp_path, mode, loop):
    check_safe(adversarial_episodes(tmp_path / "bundle", mode, 50, seed=11, loop=loop))


@pytest.fixture(scope="module")
def bundle(tmp_path_factory):
    return bundles.make_bundle(tmp_path_factory.mktemp("bundles") / "bundle", ticks=20)


def task(bundle, config, episodes, seed=0):
    motion = np.arange(episodes) % 2
    return Task(model(), bundle.folder, world(config, episodes, seed), motion, bundle.start_poses[motion], seed)


@pytest.mark.parametrize("loop", LOOPS)
def test_lockstep_is_a_robot_alone(bundle, loop):
    """The runtime of a real robot, on a virtual one, gives the same motion."""
    episodes = run_task(dataclasses.replace(task(bundle, WorldConfig(), 3), loop=loop))
    qpos = []

    class Watching(VirtualRobot):
        def read(self):
            qpos.append(self.robots.qpos[0].copy())
            return super().read()

    driver = Watching(bundle, loop)
    assert run_controller(driver, bundle, clock=driver).is_complete
    assert np.ptp(episodes.qpos[0], axis=0).min() > 0.05
    tolerance = 1e-6 if loop == "mimic" else 3e-3  # a batch of the network rounds otherwise; Ruckig's profiles branch
    np.testing.assert_allclose(episodes.qpos[0], qpos[2:22], atol=tolerance)
    np.testing.assert_allclose(episodes.qpos[0], episodes.qpos[2], atol=tolerance)


@pytest.mark.parametrize("loop", LOOPS)
def test_a_robot_without_another_command_stops_where_its_path_was_checked(bundle, loop):
    """As where the program ends in the middle of a motion."""
    driver = VirtualRobot(bundle, loop)
    layer, pose = SafetyLayer(bundle), bundle.start_pose[:, None]
    layer.start(pose, 0 * pose, pose)
    for tick in range(8):
        command = layer.tick(layer.reference.qpos, layer.reference.qvel, np.full((7, 1), 0.5))
        driver.write(Command(Reference(*(x[..., 0] for x in command.path)), command.stop[:, 0]))
        driver.wait_until(0.05 * (tick + 1))
    assert np.abs(driver.read().qvel).max() > 0.5
    driver.wait_until(2.0)
    np.testing.assert_allclose(driver.read().qpos, command.stop[:, 0], atol=0.02)
    assert np.abs(driver.read().qvel).max() < 0.01


@pytest.mark.slow
def test_processes_give_the_same_episodes(bundle):
    done: list[int] = []
    tasks = [task(bundle, hardware(), 3), task(bundle, hardware(), 2, seed=1)]
    apart = run_tasks(tasks, done.append, processes=2)
    together = [run_task(part) for part in tasks]
    assert sum(done) == 5
    for a, b in zip(apart, together, strict=True):
        np.testing.assert_array_equal(a.qpos, b.qpos)
        np.testing.assert_array_equal(a.interventions[REPEATED], b.interventions[REPEATED])


@pytest.mark.parametrize("chosen", [None, "3"])
def test_numpy_has_one_thread_in_each_process(bundle, monkeypatch, chosen):
    """Unless the user has chosen a number; this process keeps its own."""
    for name in runs._BLAS_THREADS:
        monkeypatch.delenv(name, raising=False)
    if chosen:
        monkeypatch.setenv("OMP_NUM_THREADS", chosen)
    before, inherited = dict(os.environ), []

    @contextlib.contextmanager
    def pool(_):
        inherited.extend(os.environ.get(name) for name in runs._BLAS_THREADS)
        yield SimpleNamespace(imap=map)

    monkeypatch.setattr(multiprocessing, "get_context", lambda _: SimpleNamespace(Pool=pool))
    results = run_tasks([task(bundle, WorldConfig(), 1), task(bundle, WorldConfig(), 2)], lambda _: None, processes=2)
    assert [len(episodes.motion) for episodes in results] == [1, 2]
    assert inherited == ([chosen, None, None, None] if chosen else ["1"] * 4)
    assert dict(os.environ) == before


def test_tasks_run_where_the_system_has_no_affinity(bundle, monkeypatch):
    """As on macOS."""
    monkeypatch.delattr(os, "sched_getaffinity", raising=False)
    done: list[int] = []
    run_tasks([task(bundle, WorldConfig(), 1)], done.append)
    assert done == [1]


def test_a_task_is_cut_into_groups(bundle):
    parts = groups(task(bundle, hardware(), 250))
    assert [len(part.motion) for part in parts] == [100, 100, 50] and len({part.seed for part in parts}) == 3
    assert sum(len(part.world.payload) for part in parts) == 250


def test_a_channel_delays_and_loses():
    drawn = dataclasses.replace(world(robots=3), observation_delay=np.array([0, 1, 3]), packet_loss=0.0,
                                action_delay=np.array([0, 2, 3]))  # fmt: skip
    channel = Channel(drawn, 1, seed=0)
    seen, acted = [], []
    for tick in range(5):
        seen.append(channel.observed(np.full((3, 1), float(tick)))[:, 0])
        action, is_present = channel.arrived(np.full((3, 1), float(tick)))
        acted.append(np.where(is_present, action[:, 0], -1))
    np.testing.assert_array_equal(np.array(seen).T, [[0, 1, 2, 3, 4], [0, 0, 1, 2, 3], [0, 0, 0, 0, 1]])
    np.testing.assert_array_equal(np.array(acted).T, [[0, 1, 2, 3, 4], [-1, -1, 0, 1, 2], [-1, -1, -1, 0, 1]])
    lossy = Channel(dataclasses.replace(world(robots=2000), packet_loss=0.25), 1, seed=0)
    assert 0.7 < lossy.arrived(np.zeros((2000, 1)))[1].mean() < 0.8


def test_losses_are_counted(bundle):
    lossy = run_task(task(bundle, WorldConfig(packet_loss=0.3), 4))
    total = lossy.interventions[REPEATED] + lossy.interventions[LATE]
    assert 10 < total.sum() < 40 and np.all(lossy.aborts == "")  # 4 x 20 ticks


def test_an_aborted_robot_is_counted_once_and_at_rest(bundle):
    poses = np.array([0, 0])
    robots = VirtualRobots(model(), world(robots=2), bundle.start_poses[poses])
    controller = SafeController(bundle, poses, world(robots=2), robots)
    robots.cause[1] = FLOOR_CONTACT
    episodes = run_episodes(robots, controller, poses)
    assert list(episodes.aborts) == ["", FLOOR_CONTACT] and list(episodes.stops) == ["", ""]
    assert controller._layer.cause[1] == ABORTED
    assert np.all(episodes.qvel[1] == 0) and np.ptp(episodes.qpos[1], axis=0).max() == 0
    assert episodes.tracking_error[1] == 0 and episodes.tracking_error[0] > 0


def test_robots_do_not_start_at_a_wrong_pose(bundle):
    poses = bundle.start_poses[[0]] + 0.3
    robots = VirtualRobots(model(), world(), poses)
    episodes = run_episodes(robots, SafeController(bundle, np.array([0]), world(), robots), np.array([0]))
    assert list(episodes.stops) == ["start pose"] and episodes.aborts[0] in ("", TORQUE_RATE)
    assert np.abs(episodes.qpos[0] - poses[0]).max() < 1e-3
    assert virtual().is_active.all()
