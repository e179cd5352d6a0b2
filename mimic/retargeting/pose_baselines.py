"""Retargeting baselines without a metric and without training.

Each is a function of (expert, learner, qpos [..., time, n]) that returns the learner's qpos [..., time, n_hat], or None
where it does not apply to the two arms. Independent poses are motions of one sample: [poses, 1, n].
"""

from collections.abc import Callable

import mujoco
import numpy as np
from jaxtyping import Float

from mimic.arms.chain import smallest_rotation
from mimic.arms.embodiment import Embodiment, segment_arm
from mimic.arms.model_tree import quaternion
from mimic.arms.pose_limits import pose_limits
from mimic.metric.similarity import centre_line_table
from mimic.retargeting.live_pose import joint_spec
from mimic.retargeting.pose import checked_poses, shared_joints

Poses = Float[np.ndarray, "*batch time joints"]

IK_EVERY = 5  # inverse kinematics solves every fifth sample of a motion; a solve takes 0.1 ms
_TRACKING_STEPS = 6  # from the solution of the previous solved sample
_FIRST_STEPS = 40
_RANDOM_STARTS = 3  # in addition to the home pose, for the first sample
_DIRECTION_COST = (
    0.1  # chain lengths per radian: a position error of 0.1 costs as much as a direction error of 57 degrees
)
_DAMPING, _STEP_DAMPING = 1e-6, 0.1  # constant, and per squared error
_CONVERGED = 1e-4  # rad, maximum change of a joint in a step
_HAND = "hand"


def copy_joints(expert: Embodiment, learner: Embodiment, qpos: Poses) -> Poses | None:
    """Copies the expert's angles to joints of the same name; 0 in the learner's other joints, clipped to its ranges.

    Args:
      expert: n joints.
      learner: n_hat joints.
      qpos: the expert's poses [rad].

    Returns:
      The learner's poses [rad]; None where the arms have no joint name in common.
    """
    qpos = checked_poses(expert, np.asarray(qpos), axes=("time",))
    if not set(expert.joint_names) & set(learner.joint_names):
        return None
    lower, upper = pose_limits(learner, qpos.dtype)
    return np.clip(shared_joints(expert, learner, qpos), lower, upper)


def hold_home(expert: Embodiment, learner: Embodiment, qpos: Poses) -> Poses:
    """Holds the learner's home pose; arguments as for `copy_joints`."""
    shape = checked_poses(expert, np.asarray(qpos), axes=("time",)).shape[:-1]
    return np.broadcast_to(np.asarray(learner.home, qpos.dtype), (*shape, learner.num_joints)).copy()


def hand_ik(expert: Embodiment, learner: Embodiment, qpos: Poses, *, every: int = IK_EVERY) -> Poses | None:
    """Inverse kinematics of the hand with mink: matches the position of the tip, and less strictly its direction.

    The objective is |p - p*|^2 + (0.1 angle(e, e*))^2, with the tip p in chain lengths and the direction e of the last
    segment, within the joint ranges. The first sample is the best solution from several initial guesses, one of them
    the home pose; each later one starts from the previous solution. Every fifth sample of a motion and the last one are
    solved; the joint angles between them are interpolated.

    Args:
      expert: n joints.
      learner: n_hat joints.
      qpos: the expert's poses [rad].
      every: interval between solved samples; 1 solves all.

    Returns:
      The learner's poses [rad]; None for trees, which have several hands.

    Raises:
      ValueError: `qpos` is not [..., time, n] or not finite, or `every` is below 1.
    """
    if len(expert.chains) > 1 or len(learner.chains) > 1:
        return None
    qpos = checked_poses(expert, np.asarray(qpos), axes=("time",))
    if every < 1:
        raise ValueError(f"every: expected at least 1, got {every}")
    time = qpos.shape[-2]
    solved = np.unique(np.append(np.arange(0, time, every), time - 1))
    hands = centre_line_table(expert, qpos.reshape(-1, time, expert.num_joints)[:, solved], samples=1)
    solver = _HandSolver(learner)
    motions = [
        solver.follow(*motion)
        for motion in zip(hands.hand_position.astype(float), hands.hand_direction.astype(float), strict=True)
    ]
    result = np.empty((len(motions), time, learner.num_joints), qpos.dtype)
    left = np.searchsorted(solved, np.arange(time), side="right") - 1
    right = np.minimum(left + 1, len(solved) - 1)
    fraction = (np.arange(time) - solved[left]) / np.maximum(solved[right] - solved[left], 1)
    for row, motion in zip(result, motions, strict=True):
        row[:] = motion[left] + fraction[:, None] * (motion[right] - motion[left])
    return result.reshape(*qpos.shape[:-1], learner.num_joints)


BASELINES: dict[str, Callable[[Embodiment, Embodiment, Poses], Poses | None]] = {
    "copy_joints": copy_joints,
    "hand_ik": hand_ik,
    "hold_home": hold_home,
}


def baseline_poses(expert: Embodiment, learner: Embodiment, qpos: Poses) -> dict[str, Poses]:
    """The learner's poses by each of `BASELINES` that applies to the two arms; arguments as for `copy_joints`."""
    poses_by_name = {name: baseline(expert, learner, qpos) for name, baseline in BASELINES.items()}
    return {name: poses for name, poses in poses_by_name.items() if poses is not None}


class _HandSolver:
    """Inverse kinematics by mink on a model of only the learner's joints, in chain lengths."""

    def __init__(self, learner: Embodiment):
        import mink  # takes half a second, and few need it

        self._mink = mink
        self._model = kinematic_model(learner, {_HAND: len(learner.segment_end) - 1})
        self._configuration = mink.Configuration(self._model, np.array(learner.home, float))
        # The hand's x-axis is its direction: rotation about it has no cost.
        self._task = mink.FrameTask(
            _HAND, "site", 1.0, orientation_cost=[0.0, _DIRECTION_COST, _DIRECTION_COST], lm_damping=_STEP_DAMPING
        )
        self._limits = [mink.ConfigurationLimit(self._model)]
        lower, upper = np.asarray(learner.joint_range, float).T
        random = np.random.default_rng(0).uniform(lower, upper, (_RANDOM_STARTS, learner.num_joints))
        self._starts = np.concatenate([np.asarray(learner.home, float)[None], random])
        self._firsts: dict[bytes, np.ndarray] = {}  # cache: many demonstrations have the same first pose

    def follow(self, positions: np.ndarray, directions: np.ndarray) -> np.ndarray:
        """Joint angles [time, joints] for hands [time, 3]."""
        key = positions[0].tobytes() + directions[0].tobytes()
        if key not in self._firsts:
            solutions = [self._descend(start, positions[0], directions[0], _FIRST_STEPS) for start in self._starts]
            self._firsts[key] = min(solutions, key=lambda solution: solution[1])[0]
        path = [self._firsts[key]]
        for target in zip(positions[1:], directions[1:], strict=True):
            path.append(self._descend(path[-1], *target, _TRACKING_STEPS)[0])
        return np.stack(path)

    def _descend(
        self, start: np.ndarray, position: np.ndarray, direction: np.ndarray, steps: int
    ) -> tuple[np.ndarray, float]:
        """Joint angles after some steps, and the objective at these angles."""
        configuration, mink = self._configuration, self._mink
        configuration.update(start)
        for _ in range(steps):
            frame = self._frame()
            rotated = smallest_rotation(frame[:, 0], direction) @ frame
            self._task.set_target(mink.SE3.from_rotation_and_translation(mink.SO3.from_matrix(rotated), position))
            change = mink.solve_ik(
                configuration, [self._task], 1.0, solver="daqp", damping=_DAMPING, limits=self._limits
            )
            configuration.integrate_inplace(change, 1.0)
            if np.abs(change).max() < _CONVERGED:
                break
        position_error = self._configuration.data.site(_HAND).xpos - position
        angle = np.arccos(np.clip(self._frame()[:, 0] @ direction, -1, 1))
        return configuration.q.copy(), float(position_error @ position_error + (_DIRECTION_COST * angle) ** 2)

    def _frame(self) -> np.ndarray:
        return self._configuration.data.site(_HAND).xmat.reshape(3, 3).copy()


def kinematic_model(arm: Embodiment, sites: dict[str, int]) -> mujoco.MjModel:
    """MuJoCo model of an embodiment's joints, in chain lengths; its masses are arbitrary.

    Args:
      arm: the embodiment.
      sites: segment at whose end each site is, with its x-axis along the segment, by name.
    """
    unit = float(segment_arm(arm).chain_length)
    spec, bodies = joint_spec(arm, unit)
    for number, limit in enumerate(zip(*pose_limits(arm, float), strict=True)):
        if np.all(np.isfinite(limit)):
            joint = spec.joint(str(number))
            joint.limited, joint.range = mujoco.mjtLimited.mjLIMITED_TRUE, limit
    for name, segment in sites.items():
        start, end = (np.asarray(points[segment]) / unit for points in (arm.segment_start, arm.segment_end))
        rotation = smallest_rotation(np.eye(3)[0], (end - start) / np.linalg.norm(end - start))
        body, origin = bodies[arm.link_joint[arm.segment_link[segment]] + 1]
        body.add_site(name=name, pos=end - origin, quat=quaternion(rotation))
    return spec.compile()
