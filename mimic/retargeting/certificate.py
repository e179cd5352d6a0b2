"""What a learner's motion keeps of an expert's: the hand in metres, limits, speed and clearance; and what fails."""

import dataclasses
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import numpy as np
from jaxtyping import Array, Bool, Float

from mimic.arms.capsules import Capsules
from mimic.arms.embodiment import Embodiment
from mimic.arms.pose_limits import motion_limits
from mimic.base.compilation import compiled_once
from mimic.control import clearance as control_clearance
from mimic.metric.capsule_distances import clearance_constants
from mimic.metric.kinematics import hand_frames
from mimic.retargeting.exact_chunks import by_chunks
from mimic.retargeting.hand_target import placement

POSITION, ROTATION = 1e-3, np.radians(0.5)  # m, rad: a hand within both is where the expert's is
NO_FLOOR = -1e3  # m; what the arm stands on is not known
_AT_LIMIT, _AT_RANGE = 0.999, 1e-3  # fraction of the velocity limit; rad from the end of a range
TOUCHING = -0.01  # m, where contacts are not known: capsules are larger than the shapes that they contain
_ROUNDING = 1e-5  # rad, relative: of single precision


@dataclasses.dataclass(frozen=True)
class Certificate:
    """A motion of the learner beside that of the expert, frame by frame.

    Attributes:
      position: distance between the hands [m].
      rotation: angle between them [rad].
      margin: distance of the nearest joint from the end of its range [rad]; negative beyond.
      speed: of the fastest joint between a frame and the next, as a fraction of its limit.
      clearance: between capsules around the learner's links [m], negative where these touch; NaN where its shapes are
        not known.
      causes: why a frame fails; empty where it does not.
      nearest: the two links of the smallest clearance, where it is known.
    """

    position: Float[np.ndarray, " frames"]
    rotation: Float[np.ndarray, " frames"]
    margin: Float[np.ndarray, " frames"]
    speed: Float[np.ndarray, " frames"]
    clearance: Float[np.ndarray, " frames"]
    causes: tuple[str, ...]
    nearest: str = ""

    @property
    def is_exact(self) -> Bool[np.ndarray, " frames"]:
        """Whether the hand is where the expert's is, within 1 mm and 0.5 degrees."""
        return (self.position <= POSITION) & (self.rotation <= ROTATION)

    @property
    def is_ok(self) -> bool:
        """Whether no frame fails."""
        return not any(self.causes)

    def failures(self) -> Iterator[tuple[int, int, str]]:
        """First and last frame of each run of frames that fail for one cause, and the cause."""
        first = 0
        for frame in range(1, len(self.causes) + 1):
            if frame == len(self.causes) or self.causes[frame] != self.causes[first]:
                if self.causes[first]:
                    yield first, frame - 1, self.causes[first]
                first = frame

    def summary(self) -> dict[str, Any]:
        """The figures of the motion, for a report."""
        return {
            "frames": len(self.causes),
            "exact_frames": int(self.is_exact.sum()),
            "largest_error_mm": 1e3 * float(self.position.max()),
            "largest_error_deg": float(np.degrees(self.rotation.max())),
            "smallest_margin_deg": float(np.degrees(self.margin.min())),
            "largest_speed": float(self.speed.max()),
            "smallest_clearance_mm": 1e3 * float(self.clearance.min()),
            "ok": self.is_ok,
            "failures": [{"first": a, "last": b, "cause": cause} for a, b, cause in self.failures()],
        }


def certify(
    expert: Embodiment,
    learner: Embodiment,
    expert_qpos: Float[np.ndarray, "frames expert_joints"],
    qpos: Float[np.ndarray, "frames joints"],
    largest_jump: Float[np.ndarray, " joints"],
    *,
    base: Sequence[float] | None = None,
    capsules: Capsules | None = None,
    contacts: Callable[[Float[np.ndarray, "frames joints"]], Bool[np.ndarray, " frames"]] | None = None,
    demands_hand: bool = True,
) -> Certificate:
    """Compares a motion of the learner with the expert's.

    Args:
      expert, learner: arms with one hand each for every chain; errors of the hands are NaN where an arm has none.
      expert_qpos: the expert's motion [rad].
      qpos: the learner's [rad].
      largest_jump: change of each joint at its velocity limit between two frames [rad].
      base: the learner's base in the expert's base frame, [x, y, z, yaw] [m, rad]; None for the same.
      capsules: of the learner, from `fit_capsules`, for the clearance.
      contacts: from `make_contacts`, which decides where capsules touch.
      demands_hand: whether a frame fails whose hand is not where the expert's is.
    """
    position, rotation = hand_errors(expert, learner, expert_qpos, qpos, base)
    lower, upper = motion_limits(learner)
    margins = np.minimum(qpos - lower, upper - qpos)
    steps = np.abs(np.diff(qpos, axis=0)) / largest_jump
    steps = np.concatenate([steps, np.zeros((1, qpos.shape[1]))])  # after the last frame the arm stands
    clearance, nearest = np.full(len(qpos), np.nan), ""
    if capsules is not None:
        constants = clearance_constants(learner, capsules, NO_FLOOR)
        clearance = control_clearance.clearance(qpos, constants)
        if len(constants.pairs):
            axes = control_clearance.capsule_axes(qpos[clearance.argmin()], constants)
            pair = constants.pairs[control_clearance.pair_distances(*axes, constants).argmin()]
            nearest = " and ".join(capsules.links(learner)[capsule] for capsule in pair)
    touches = clearance < TOUCHING
    if contacts is not None:
        touches = clearance < 0
        touches[touches] = contacts(qpos[touches])
    is_exact = (position <= POSITION) & (rotation <= ROTATION)
    least, fastest = margins.min(axis=1), steps.max(axis=1)
    fails = (least < -_ROUNDING) | (fastest > 1 + _ROUNDING) | touches | (demands_hand & ~is_exact)
    causes = [""] * len(qpos)
    for frame in np.flatnonzero(fails):
        if least[frame] < -_ROUNDING:
            cause = f"{learner.joint_names[int(margins[frame].argmin())]} beyond its range"
        elif fastest[frame] > 1 + _ROUNDING:
            cause = f"{learner.joint_names[int(steps[frame].argmax())]} beyond its velocity limit"
        elif touches[frame]:
            cause = "links touch"
        else:
            near = steps[max(frame - 1, 0) : frame + 1].max(axis=0)
            cause = "hand out of reach"
            if near.max() > _AT_LIMIT:
                cause = f"hand not reached: {learner.joint_names[int(near.argmax())]} is at its velocity limit"
            elif least[frame] < _AT_RANGE:
                cause = f"hand not reached: {learner.joint_names[int(margins[frame].argmin())]} is at its range"
        causes[frame] = cause
    return Certificate(position, rotation, least, fastest, clearance, tuple(causes), nearest)


def hand_errors(
    expert: Embodiment, learner: Embodiment, expert_qpos: np.ndarray, qpos: np.ndarray, base: Sequence[float] | None
) -> tuple[Float[np.ndarray, " frames"], Float[np.ndarray, " frames"]]:
    """Distances [m] and angles [rad] between the hands; of several hands the largest. See `certify`."""
    if not (expert.hand_joint and learner.hand_joint):
        return np.full(len(qpos), np.nan), np.full(len(qpos), np.nan)
    (hand, rotation), (own, own_rotation) = (
        by_chunks(_hands(arm), np.asarray(values, np.float32))
        for arm, values in ((expert, expert_qpos), (learner, qpos))
    )
    turn, translation = placement(base)
    difference = np.swapaxes(rotation, -1, -2) @ turn @ own_rotation
    skew = difference - np.swapaxes(difference, -1, -2)
    sine = np.sqrt(np.sum(skew**2, axis=(-1, -2)) / 8)
    cosine = (np.trace(difference, axis1=-1, axis2=-2) - 1) / 2
    distance = np.linalg.norm(hand - own @ turn.T - translation, axis=-1)
    return distance.max(axis=-1), np.arctan2(sine, cosine).max(axis=-1)


@compiled_once
def _hands(arm: Embodiment) -> Callable[[Array], tuple[Array, Array]]:
    """The function from poses to positions and rotations of the hands."""

    def frames(qpos: Array) -> tuple[Array, Array]:
        hands = hand_frames(arm, qpos)
        return hands.position, hands.rotation

    return frames
