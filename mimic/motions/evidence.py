"""Joint angles beside what their source says of them otherwise: by velocities, by commands, and by the hand.

Each piece of evidence is a function from angles to errors, see `mimic.motions.doubts`.
"""

from collections.abc import Callable, Iterator, Mapping
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from mimic.arms.embodiment import Embodiment
from mimic.arms.link_match import hand_poses
from mimic.motions.formats.episodes import Motion

VELOCITIES = "the velocities"
_ROWS, _HAND_ROWS = 400, 60  # samples that are compared
_SLOW = 0.05  # rad/s, of velocities that are noise
RELATIVE = 0.6  # of velocities and of commands: tolerance of errors, relative to how much they vary
_LAGS = 0.0, 0.05, 0.1, 0.2, 0.3, 0.5  # s, of measured angles behind commands
_SHORT_PATH, _FITS = 0.03, 5.0  # m, mm: a path of the hand that says nothing, and an error that is none
_FIT_STEPS, _TOOL_STIFFNESS = 8, 0.02  # Gauss-Newton; the tool's offset must not explain all
_STEP_LAG, _UNCORRELATED = 1, 0.4  # samples from a commanded step of the hand; 1 minus the correlation
_PRESSES = 0.5  # of the median over commanded axes: the hand's steps for commanded ones, where something holds it
_COMMANDED = 0.01  # of the most commanded axis: the sum of squares of one that is commanded


class Evidence(NamedTuple):
    """What angles are compared with.

    Attributes:
      name: of the evidence, in messages.
      rows: angles that are compared [rad].
      errors: function from [candidates, rows, joints] to errors [candidates, parts]; parts are joints, or one.
      tolerance: of errors.
      unit: of errors, in messages.
      has_zeros: whether shifted zeros are tried as the cause.
      is_weak: whether it counts only where nothing else is wrong.
    """

    name: str
    rows: Float[np.ndarray, "rows joints"]
    errors: Callable[[np.ndarray], np.ndarray]
    tolerance: float
    unit: str
    has_zeros: bool = True
    is_weak: bool = False


class Samples(NamedTuple):
    """All samples of all motions, and the rows that are compared: each is followed by another of the same motion."""

    time: np.ndarray
    qpos: np.ndarray
    rows: np.ndarray
    ends: np.ndarray  # of the motion of each row

    def later(self, seconds: float) -> np.ndarray:
        """The rows some time after those that are compared."""
        return np.minimum(np.searchsorted(self.time, self.time[self.rows] + seconds - 1e-6), self.ends)

    def chosen(self, count: int) -> np.ndarray:
        """Some of the rows, with the same distance from each to the next."""
        return self.rows[np.linspace(0, len(self.rows) - 1, min(count, len(self.rows))).astype(int)]


def samples_of(motions: Mapping[str, Motion]) -> Samples:
    """Times are those of one motion after the other."""
    lengths = [len(motion.time) for motion in motions.values()]
    ends = np.repeat(np.cumsum(lengths), lengths) - 1
    qpos = np.concatenate([motion.qpos for motion in motions.values()])
    shift, times = 0.0, []
    for motion in motions.values():
        times.append(motion.time - motion.time[0] + shift)
        shift = times[-1][-1] + 1.0
    rows = np.flatnonzero(np.arange(len(ends)) < ends)
    rows = rows[np.linspace(0, len(rows) - 1, min(len(rows), _ROWS)).astype(int)] if len(rows) else rows
    return Samples(np.concatenate(times), qpos, rows, ends[rows])


def _every(motions: Mapping[str, Motion], key: str) -> np.ndarray | None:
    """A field of all motions; None where one lacks it, or where it is no number."""
    values = [getattr(motion, key) for motion in motions.values()]
    if any(value is None or not np.all(np.isfinite(value)) for value in values):
        return None
    return np.concatenate(values)


def evidence_of(
    arm: Embodiment,
    samples: Samples,
    motions: Mapping[str, Motion],
    commands: Mapping[str, Mapping[str, Motion]],
) -> Iterator[Evidence]:
    """What the source says of the angles."""
    if (qvel := _every(motions, "qvel")) is not None and np.abs(qvel).max() > _SLOW:
        yield _of_velocities(samples, qvel)
    for entry, found in commands.items():
        if (goal := _every({name: found[name] for name in motions}, "qpos")) is not None:
            yield _of_commands(samples, entry, goal)
    if len(arm.hand_joint) == 1:
        if (hand := _every(motions, "hand")) is not None:
            chosen = samples.chosen(_HAND_ROWS)
            if np.ptp(hand[chosen], axis=0).max() > _SHORT_PATH:
                yield _of_hands(arm, samples.qpos[chosen], hand[chosen])
        if (steps := _every(motions, "hand_step")) is not None and steps.any():
            yield _of_hand_steps(arm, samples, steps)


def _of_velocities(samples: Samples, qvel: np.ndarray) -> Evidence:
    """Errors of each joint's velocity, relative to how fast it is."""
    first, second = samples.rows, samples.rows + 1
    stated, dt = (qvel[first] + qvel[second]) / 2, (samples.time[second] - samples.time[first])[:, None]
    typical = _SLOW + np.sqrt(np.mean(stated**2, axis=0))

    def errors(qpos: np.ndarray) -> np.ndarray:
        rate = (qpos[:, len(first) :] - qpos[:, : len(first)]) / dt
        return np.sqrt(np.mean((rate - stated) ** 2, axis=1)) / typical

    rows = np.concatenate([samples.qpos[first], samples.qpos[second]])
    return Evidence(VELOCITIES, rows, errors, RELATIVE, " of their own", False)


def _of_commands(samples: Samples, entry: str, goal: np.ndarray) -> Evidence:
    """Errors of each joint from its commands, relative to how far it is commanded; the lag is the one that fits."""
    stated, count = goal[samples.rows], len(samples.rows)
    typical = 0.1 + np.std(stated, axis=0)

    def errors(qpos: np.ndarray) -> np.ndarray:
        apart = qpos.reshape(len(qpos), len(_LAGS), count, -1) - stated
        of_lags = np.sqrt(np.mean(apart**2, axis=2)) / typical
        lag = of_lags.mean(axis=2).argmin(axis=1)
        return of_lags[np.arange(len(qpos)), lag]

    rows = np.concatenate([samples.qpos[samples.later(lag)] for lag in _LAGS])
    return Evidence(entry, rows, errors, RELATIVE, " of its range")


def _of_hands(arm: Embodiment, qpos: np.ndarray, hand: np.ndarray) -> Evidence:
    """The error [mm] with which the hand is at its stated positions, for the best base and the best point of a tool."""

    def errors(qpos: np.ndarray) -> np.ndarray:
        position, axes = hand_points(arm, qpos)
        centred, goal = position - position.mean(axis=1, keepdims=True), hand - hand.mean(axis=0)
        left, _, right = np.linalg.svd(np.swapaxes(centred, 1, 2) @ goal)
        flip = np.linalg.det(left @ right)[:, None] * [0, 0, 1] + [1, 1, 0]
        turn = np.swapaxes((left * flip[:, None]) @ right, 1, 2)
        tool, eye = np.zeros((len(qpos), 3)), np.eye(3)
        for _ in range(_FIT_STEPS):
            points = (position + (axes @ tool[:, None, :, None])[..., 0]) @ np.swapaxes(turn, 1, 2)
            apart = points - points.mean(axis=1, keepdims=True) - goal
            arms = points - points.mean(axis=1, keepdims=True)
            by_turn = -np.cross(arms[:, :, None], eye)  # [.., axis, 3]: of small rotations
            by_tool = np.swapaxes(turn[:, None] @ axes, 2, 3)
            by_tool = by_tool - by_tool.mean(axis=1, keepdims=True)
            slopes = np.concatenate([by_turn, by_tool], axis=2).swapaxes(2, 3).reshape(len(qpos), -1, 6)
            stiff = np.diag([1e-9] * 3 + [_TOOL_STIFFNESS * len(hand)] * 3)
            force = np.swapaxes(slopes, 1, 2) @ apart.reshape(len(qpos), -1, 1)
            force[:, 3:, 0] += _TOOL_STIFFNESS * len(hand) * tool
            step = -np.linalg.solve(np.swapaxes(slopes, 1, 2) @ slopes + stiff, force)[..., 0]
            turn, tool = _rotations(step[:, :3]) @ turn, tool + step[:, 3:]
        return 1e3 * np.sqrt(np.mean(np.sum(apart**2, axis=2), axis=1))[:, None]

    return Evidence("the positions of the hand", qpos, errors, _FITS, " mm")


def _of_hand_steps(arm: Embodiment, samples: Samples, steps: np.ndarray) -> Evidence:
    """1 minus the correlation of the hand's steps with commanded ones, in the axes of the base.

    An axis in which the hand hardly moves for its commands does not count: it may press on something, as on a table.
    """
    first = np.minimum(samples.rows + _STEP_LAG, samples.ends - 1)
    stated = steps[samples.rows]

    def errors(qpos: np.ndarray) -> np.ndarray:
        position, _ = hand_points(arm, qpos)
        step = position[:, len(first) :] - position[:, : len(first)]
        products, squares, commanded = np.sum(step * stated, axis=1), np.sum(step**2, axis=1), np.sum(stated**2, axis=0)
        is_led = commanded > _COMMANDED * commanded.max()
        gain = np.sqrt(squares / np.where(is_led, commanded, 1.0))
        counts = ~is_led | (gain >= _PRESSES * np.median(gain[:, is_led], axis=1, keepdims=True))
        norms = np.sqrt(np.sum(counts * squares, axis=1) * np.sum(counts * commanded, axis=1))
        return (1 - np.sum(counts * products, axis=1) / np.maximum(norms, 1e-12))[:, None]

    rows = np.concatenate([samples.qpos[first], samples.qpos[first + 1]])
    return Evidence(
        "the commanded steps of the hand", rows, errors, _UNCORRELATED, " (1 minus the correlation)", False, True
    )


def hand_points(arm: Embodiment, qpos: Float[np.ndarray, "*rows joints"]) -> tuple[np.ndarray, np.ndarray]:
    """Positions [*rows, 3] [m] and rotations [*rows, 3, 3] of an arm's only hand, by NumPy alone."""
    poses = hand_poses(arm, qpos)[..., 0, :, :]
    return poses[..., :3, 3], poses[..., :3, :3]


def _rotations(vectors: np.ndarray) -> np.ndarray:
    """Rotations [n, 3, 3] by vectors of rotation [n, 3]."""
    from scipy.spatial.transform import Rotation  # a tenth of a second to import

    return Rotation.from_rotvec(vectors).as_matrix()
