"""Retargeting as in General Motion Retargeting (GMR; Araujo, Ze et al., arXiv 2510.02252), for one arm.

Frames of the robot are matched by hand to those of the person: here elbow, wrist and hand. Each part of the person's
arm is scaled to the length of the robot's. mink then minimises squared errors of the frames in two stages, at each time
from the pose before: first all orientations and the position of the hand, then all positions and orientations. A stage
ends after 10 steps, or where a step improves its error by less than 0.001 of it.
"""

from typing import Any

import mink
import numpy as np

from benchmarks.peers.landmarks import Landmarks, landmarks, part_directions
from mimic.arms.chain import smallest_rotation
from mimic.arms.embodiment import Embodiment
from mimic.retargeting.pose_baselines import Poses, kinematic_model

_FRAMES = ("elbow", "wrist", "hand")
# Costs (position, orientation) of each frame in each stage, per chain length and rad: of orientations of 0.03, 0.1, 0.3
# and 1 in the second stage, the first has the nearest centre lines for four of four arms.
_STAGES = (
    ((0.0, 0.3), (0.0, 0.3), (1.0, 0.3)),
    ((1.0, 0.03), (1.0, 0.03), (1.0, 0.03)),
)
_MAX_STEPS, _IMPROVEMENT = 10, 1e-3
_FIRST_STEPS = 100
_DAMPING = 1e-4


def match_frames(expert: Embodiment, learner: Embodiment, qpos: Poses, expert_marks: Landmarks) -> Poses | None:
    """The learner's motion [time, learner_joints] for the expert's [time, joints]; None where it has no elbow.

    The orientation of a frame is the direction of the part that ends there; its rotation about the part is free, as a
    person's is unknown from points.
    """
    marks = landmarks(learner)
    if marks is None:
        return None
    directions = part_directions(expert, expert_marks, qpos)  # [parts, time, 3]
    zero = np.concatenate([np.asarray(learner.segment_start)[:1], np.asarray(learner.segment_end)])
    unit = 1 / float(np.linalg.norm(np.diff(zero, axis=0), axis=1).sum())
    points = unit * zero[list(marks)]
    lengths = np.linalg.norm(np.diff(points, axis=0), axis=1)
    positions = points[0] + np.cumsum(directions * lengths[:, None, None], axis=0)
    solver = _Solver(learner, marks)
    pose, path = np.asarray(learner.home, float), []
    for time in range(len(qpos)):
        pose = solver.solve(pose, positions[:, time], directions[:, time], _MAX_STEPS if time else _FIRST_STEPS)
        path.append(pose)
    return np.stack(path)


class _Solver:
    """Two stages of inverse kinematics on the frames of one arm."""

    def __init__(self, learner: Embodiment, marks: Landmarks):
        self._model = kinematic_model(learner, dict(zip(_FRAMES, (mark - 1 for mark in marks[1:]), strict=True)))
        self._configuration = mink.Configuration(self._model, np.array(learner.home, float))
        self._limits = [mink.ConfigurationLimit(self._model)]
        self._along = self._directions_in_sites(learner, marks)
        self._stages = [
            [mink.FrameTask(name, "site", p, o, lm_damping=0.1) for name, (p, o) in zip(_FRAMES, costs, strict=True)]
            for costs in _STAGES
        ]

    def _directions_in_sites(self, learner: Embodiment, marks: Landmarks) -> list[np.ndarray]:
        """Directions of the parts in the frames of their sites, in the zero pose."""
        self._configuration.update(np.zeros(learner.num_joints))
        directions = part_directions(learner, marks, np.zeros((1, learner.num_joints)))[:, 0]
        return [self._rotation(name).T @ part for name, part in zip(_FRAMES, directions, strict=True)]

    def _rotation(self, name: str) -> np.ndarray:
        return self._configuration.data.site(name).xmat.reshape(3, 3).copy()

    def solve(self, start: np.ndarray, positions: np.ndarray, directions: np.ndarray, steps: int) -> np.ndarray:
        """Joint angles that match positions and directions [frames, 3], from a start."""
        self._configuration.update(start)
        for tasks in self._stages:
            last = np.inf
            for _ in range(steps):
                self._aim(tasks, positions, directions)
                error = self._error(tasks)
                if last - error < _IMPROVEMENT * error:
                    break
                last = error
                change: Any = mink.solve_ik(
                    self._configuration, tasks, 1.0, solver="daqp", damping=_DAMPING, limits=self._limits
                )
                self._configuration.integrate_inplace(change, 1.0)
        return self._configuration.q.copy()

    def _aim(self, tasks: list[mink.FrameTask], positions: np.ndarray, directions: np.ndarray) -> None:
        for task, name, along, position, direction in zip(
            tasks, _FRAMES, self._along, positions, directions, strict=True
        ):
            rotation = self._rotation(name)
            goal = mink.SO3.from_matrix(smallest_rotation(rotation @ along, direction) @ rotation)
            task.set_target(mink.SE3.from_rotation_and_translation(goal, position))

    def _error(self, tasks: list[mink.FrameTask]) -> float:
        errors = [task.cost * task.compute_error(self._configuration) for task in tasks]
        return float(np.linalg.norm(np.concatenate(errors)))
