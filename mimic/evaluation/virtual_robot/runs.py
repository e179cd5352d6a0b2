"""Runs many episodes on virtual robots, in several processes."""

import contextlib
import dataclasses
import multiprocessing
import os
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np

from mimic.deploy.bundle import load_bundle
from mimic.evaluation.virtual_robot.arm_model import RobotModel
from mimic.evaluation.virtual_robot.draws import World
from mimic.evaluation.virtual_robot.episodes import (
    Episodes,
    SafeController,
    Tracker,
    TrackingPolicy,
    joined,
    run_episodes,
)
from mimic.evaluation.virtual_robot.robots import VirtualRobots

GROUP = 100  # robots in lockstep: more are not faster
# Environment variables, which NumPy's libraries read when it is imported.
_BLAS_THREADS = "OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "VECLIB_MAXIMUM_THREADS"


@dataclasses.dataclass(frozen=True)
class Task:
    """Episodes that run in lockstep.

    Attributes:
      robot: the model.
      policy: folder of a bundle, or poses to track.
      world: of each episode.
      motion: [episodes] index of the motion.
      start_poses: [episodes, joints] [rad].
      seed: of noise and losses.
      loop: of the robots, see `ControlLoop`.
    """

    robot: RobotModel
    policy: Path | TrackingPolicy
    world: World
    motion: np.ndarray
    start_poses: np.ndarray
    seed: int
    loop: str = "mimic"


def run_task(task: Task) -> Episodes:
    """Runs the episodes of a task."""
    robots = VirtualRobots(task.robot, task.world, task.start_poses, task.seed)
    if isinstance(task.policy, TrackingPolicy):
        bundle = load_bundle(task.policy.bundle)
        tracker = Tracker(task.policy, bundle, task.motion)
        # It knows the reference of the inner loop itself, without the delay of a measurement.
        world = dataclasses.replace(task.world, observation_delay=np.zeros_like(task.world.observation_delay))
        controller = SafeController(bundle, task.motion, world, robots, task.loop, seed=task.seed, policy=tracker)
    else:
        bundle = load_bundle(task.policy)
        controller = SafeController(bundle, task.motion, task.world, robots, task.loop, seed=task.seed)
    return run_episodes(robots, controller, task.motion)


def groups(task: Task) -> list[Task]:
    """A task in parts of at most `GROUP` episodes."""
    parts = [slice(i, i + GROUP) for i in range(0, len(task.motion), GROUP)]
    return [
        dataclasses.replace(
            task,
            world=task.world.select(part),
            motion=task.motion[part],
            start_poses=task.start_poses[part],
            seed=task.seed + part.start,
        )
        for part in parts
    ]


def run_tasks(tasks: list[Task], update: Callable[[int], None], processes: int | None = None) -> list[Episodes]:
    """Runs tasks in processes, one for each core.

    Args:
      tasks: each gives one result.
      update: is called with the number of episodes that have ended.
      processes: number of them; 1 runs all in this process.
    """
    parts = [(i, part) for i, task in enumerate(tasks) for part in groups(task)]
    processes = min(processes or _num_cores(), len(parts))
    results: dict[int, list[Episodes]] = {i: [] for i in range(len(tasks))}
    if processes == 1:
        for i, part in parts:
            results[i].append(run_task(part))
            update(len(part.motion))
        return [joined(results[i]) for i in range(len(tasks))]
    with _one_thread_each(), multiprocessing.get_context("spawn").Pool(processes) as pool:
        for (i, part), result in zip(parts, pool.imap(run_task, [part for _, part in parts]), strict=True):
            results[i].append(result)
            update(len(part.motion))
    return [joined(results[i]) for i in range(len(tasks))]


@contextlib.contextmanager
def _one_thread_each() -> Iterator[None]:
    """Context in which NumPy has one thread in new processes, unless the user has set a number.

    Otherwise each of them has a thread for each core, which wait for each other: on 16 cores that takes over twice as
    long.
    """
    added = () if any(name in os.environ for name in _BLAS_THREADS) else _BLAS_THREADS
    os.environ.update(dict.fromkeys(added, "1"))
    try:
        yield
    finally:
        for name in added:
            os.environ.pop(name, None)


def _num_cores() -> int:
    """The cores that this process may use; all of them where the system does not tell, as on macOS."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
