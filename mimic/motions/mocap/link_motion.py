"""Links over time without joints or a model: an expert of the metric that was only seen."""

import dataclasses
from typing import Any

import numpy as np
from jaxtyping import Float
from scipy import signal

from mimic.metric.kinematics import LinkStates
from mimic.motions.mocap.arms import find_arms, find_facing
from mimic.motions.mocap.conventions import mean_point
from mimic.motions.mocap.points import SIDES, ArmPoints, PointMotion

CUTOFF = 6.0  # Hz; usual for human motion (Winter, Biomechanics and Motor Control of Human Movement)
ARM_LINKS = ("upper_arm", "forearm", "hand")
TRUNK = "trunk"
BOTH = "both"  # arms
_SHORTEST = 1e-3  # m


@dataclasses.dataclass(frozen=True)
class LinkMotion:
    """Start and end of each link over time, in a base frame with z up.

    Attributes:
      names: of the links.
      parents: index of each link's parent, -1 for a link at the base.
      start, end: [time, links, 3] [m].
      rate: samples per second.
      name: of the body.
    """

    names: tuple[str, ...]
    parents: tuple[int, ...]
    start: Float[np.ndarray, "time links 3"]
    end: Float[np.ndarray, "time links 3"]
    rate: float
    name: str = "body"

    def __post_init__(self) -> None:
        links = len(self.names)
        for name, values in (("start", self.start), ("end", self.end)):
            if values.ndim != 3 or values.shape[1:] != (links, 3) or len(values) != len(self.start):
                raise ValueError(f"{name}: expected shape [time, {links}, 3], got {values.shape}")
            if not np.all(np.isfinite(values)):
                raise ValueError(f"{name}: expected finite positions [m]; bridge or split at gaps first")
        if len(self.parents) != links or any(not -1 <= parent < i for i, parent in enumerate(self.parents)):
            raise ValueError(f"parents: expected an earlier link or -1 for each of {links} links, got {self.parents}")
        short = [name for name, length in zip(self.names, self.link_lengths, strict=True) if length < _SHORTEST]
        if short:
            raise ValueError(f"links: expected lengths above {_SHORTEST} m, got less for {', '.join(short)}")

    @property
    def num_links(self) -> int:
        """Number of links."""
        return len(self.names)

    @property
    def link_lengths(self) -> Float[np.ndarray, " links"]:
        """Median length of each link [m]."""
        return np.median(np.linalg.norm(self.end - self.start, axis=2), axis=0)

    @property
    def chain_length(self) -> float:
        """Largest sum of link lengths from the base to an end [m]."""
        reach: list[float] = []
        for length, parent in zip(self.link_lengths, self.parents, strict=True):
            reach.append(float(length) + (reach[parent] if parent >= 0 else 0.0))
        return max(reach)

    @property
    def base_points(self) -> Float[np.ndarray, "links 3"]:
        """Mean start of the tree that each link belongs to [m]."""
        roots: list[int] = []
        for link, parent in enumerate(self.parents):
            roots.append(roots[parent] if parent >= 0 else link)
        return self.start[:, roots].mean(axis=0)

    def children(self, link: int) -> list[int]:
        """Indices of the links that start at a link, or at the base for -1."""
        return [child for child, parent in enumerate(self.parents) if parent == link]

    def cut(self, start: int, stop: int) -> "LinkMotion":
        """The samples from `start` up to `stop`."""
        return dataclasses.replace(self, start=self.start[start:stop], end=self.end[start:stop])


def arm_motion(
    motion: PointMotion,
    side: str = "right",
    *,
    arms: dict[str, ArmPoints] | None = None,
    facing: dict[str, tuple[str, ...]] | None = None,
    trunk: float = 0.0,
    cutoff: float = CUTOFF,
    name: str = "",
) -> LinkMotion:
    """Upper arm, forearm and, if it was captured, hand of a body, as seen from the shoulder; of one arm or of both.

    The base frame has its origin in the shoulder, z up, and x to where the body faces: perpendicular to the line
    through both shoulders, low-pass filtered. Without the other shoulder, x is that of the capture. For both arms the
    origin is in the middle between the shoulders, and each arm starts at the mean place of its own.

    Args:
      motion: all points must be known at all times; see `bridge_gaps`.
      side: "left", "right" or "both".
      arms: names of the points of the arms; found where None.
      facing: see `find_facing`; found where None.
      trunk: length of a link that stands upright below the shoulder [m], as the base column of most robots; the base
        frame is then at its lower end. 0 for none.
      cutoff: of the facing direction [Hz].
      name: of the body.

    Raises:
      ValueError: the body has no such arm, or a point is missing at some time.
    """
    arms = find_arms(motion) if arms is None else arms
    if not set(sides(side)) <= set(arms):
        raise ValueError(f"arm: expected one of {', '.join(arms) or 'none that was found'}, got {side!r}")
    facing = find_facing(motion) if facing is None else facing
    shoulders = [mean_point(motion, arms[arm].shoulder) for arm in sides(side)]
    origin, frames = np.mean(shoulders, axis=0), facing_frames(motion, facing, cutoff)
    names: list[str] = []
    parents: list[int] = []
    start, end = [], []
    for arm in sides(side):
        points = link_ends(motion, arms[arm], origin, frames, trunk)
        links = ((TRUNK,) if trunk else ()) + ARM_LINKS
        links = links[: points.shape[1] - 1]
        parents += [-1, *range(len(names), len(names) + len(links) - 1)]
        names += [f"{arm}_{link}" if side == BOTH else link for link in links]
        start.append(points[:, :-1])
        end.append(points[:, 1:])
    points = np.concatenate(start, axis=1), np.concatenate(end, axis=1)
    default = "both_arms" if side == BOTH else f"{side}_arm"
    return LinkMotion(tuple(names), tuple(parents), *points, motion.rate, name or default)


def sides(side: str) -> tuple[str, ...]:
    """The sides of "left", "right" or "both"."""
    return SIDES if side == BOTH else (side,)


def link_ends(
    motion: PointMotion,
    arm: ArmPoints,
    origin: Float[np.ndarray, "time 3"],
    frames: Float[np.ndarray, "time 3 3"],
    trunk: float,
) -> Float[np.ndarray, "time ends 3"]:
    """Lower end of the trunk if it has a length, shoulder, elbow, wrist and, if it was captured, hand, in frames [m].

    Raises:
      ValueError: a point is missing at some time.
    """
    groups = [group for group in (arm.shoulder, arm.elbow, arm.wrist, arm.hand) if group]
    points = np.stack([mean_point(motion, group) for group in groups], axis=1)
    if not np.all(np.isfinite(points)):
        raise ValueError("motion: expected all points of the arm at all times; bridge or split at gaps first")
    seen = (points - origin[:, None]) @ frames
    return np.concatenate([seen[:, :1], seen + [0, 0, trunk]], axis=1) if trunk else seen


def facing_frames(
    motion: PointMotion, facing: dict[str, tuple[str, ...]], cutoff: float = CUTOFF
) -> Float[np.ndarray, "time 3 3"]:
    """Rotation at each time whose columns are forward, left and up of the body, in the frame of the capture."""
    if not facing:
        return np.tile(np.eye(3), (len(motion.positions), 1, 1))
    left = mean_point(motion, facing["left"]) - mean_point(motion, facing["right"])
    left = low_pass(left * np.array([1.0, 1.0, 0.0]), motion.rate, cutoff)
    length = np.linalg.norm(left, axis=1, keepdims=True)
    if np.any(~(length > _SHORTEST)):
        raise ValueError("shoulders: expected two that are apart in the horizontal plane at all times")
    left = left / length
    up = np.tile([0.0, 0.0, 1.0], (len(left), 1))
    return np.stack([np.cross(left, up), left, up], axis=2)


def motion_states(motion: LinkMotion, *, cutoff: float = CUTOFF, normalized: bool = True) -> LinkStates:
    """Link states over time, as `link_states` gives those of an arm.

    Links are rigid: they have their median length and start at the end of their parent. Directions are those of the
    points behind a Butterworth filter of second order, applied forwards and backwards, so that nothing is delayed;
    their derivatives are central differences. The angular velocity is direction x derivative: two points of a link do
    not show its rotation about itself.

    Args:
      motion: the links.
      cutoff: of the filter [Hz], at which amplitudes are halved; half the sampling rate or more for no filter.
      normalized: divide positions and linear velocities by the chain length.

    Returns:
      Arrays [time, links, 3]; positions are those of the links' middles.

    Raises:
      ValueError: fewer than 2 samples, or a cutoff of 0 or less.
    """
    if len(motion.start) < 2:
        raise ValueError(f"motion: expected at least 2 samples, got {len(motion.start)}")
    span = low_pass(motion.end - motion.start, motion.rate, cutoff)
    direction = span / np.linalg.norm(span, axis=2, keepdims=True)
    angular = np.cross(direction, _derivative(direction, motion.rate))
    lengths = motion.link_lengths[:, None]
    middle, middle_velocity = (
        _along_tree(motion, direction * lengths),
        _along_tree(motion, np.cross(angular, direction) * lengths),
    )
    unit = 1 / motion.chain_length if normalized else 1.0
    states: Any = unit * (middle + motion.base_points), direction, unit * middle_velocity, angular  # NumPy's arrays
    return LinkStates(*states)


def rigid_error(motion: LinkMotion, *, cutoff: float = CUTOFF) -> float:
    """Root mean square distance [m] of the captured middles of the links from those of `motion_states`."""
    rigid = motion_states(motion, cutoff=cutoff, normalized=False).position
    return float(np.sqrt(np.mean(np.sum((0.5 * (motion.start + motion.end) - rigid) ** 2, axis=-1))))


def _along_tree(motion: LinkMotion, spans: np.ndarray) -> np.ndarray:
    """Middles of links with these spans [time, links, 3], each of which starts at the end of its parent."""
    ends: list[np.ndarray] = []
    middles = []
    for link, parent in enumerate(motion.parents):
        start = ends[parent] if parent >= 0 else np.zeros_like(spans[:, 0])
        middles.append(start + 0.5 * spans[:, link])
        ends.append(start + spans[:, link])
    return np.stack(middles, axis=1)


def low_pass(values: Float[np.ndarray, "time *axes"], rate: float, cutoff: float) -> Float[np.ndarray, "time *axes"]:
    """Values behind a low-pass filter without delay, whose gain at the cutoff is one half.

    Args:
      values: at equal intervals.
      rate: samples per second.
      cutoff: frequency [Hz]; half the rate or more for no filter.

    Raises:
      ValueError: a cutoff of 0 or less.
    """
    if not cutoff > 0:
        raise ValueError(f"cutoff: expected a frequency above 0 Hz, got {cutoff}")
    if cutoff >= rate / 2:
        return values
    sections = signal.butter(2, cutoff, fs=rate, output="sos")
    # Odd extension by a period of the cutoff keeps the ends, as far as there are samples.
    pad = min(int(np.ceil(rate / cutoff)) * 3, len(values) - 1)
    return signal.sosfiltfilt(sections, values, axis=0, padlen=pad)


def _derivative(values: np.ndarray, rate: float) -> np.ndarray:
    order = 2 if len(values) > 2 else 1
    return np.gradient(values, 1 / rate, axis=0, edge_order=order)
