"""Points of a person, or a hand, that arrive one sample at a time, and the pose of an arm in each.

A sample is a line of JSON: {"time": 12.34, "points": {"LeftArm": [0.1, 0.2, 1.4], ...}}, in seconds and metres, z up. A
point that is not seen is null or left out. For a hand see `live_hand`.
"""

import dataclasses
import json
import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from mimic.motions.mocap.arms import find_arms, unnamed
from mimic.motions.mocap.ball_chain import ball_chain_pose
from mimic.motions.mocap.clips import turn_matrix, turned
from mimic.motions.mocap.conventions import UNITS, arm_length, find_up, guessed_units, mean_point, z_up
from mimic.motions.mocap.link_motion import LinkMotion, arm_motion, facing_frames, link_ends
from mimic.motions.mocap.live_hand import LiveHand, is_number, parse_hand
from mimic.motions.mocap.points import ArmPoints, PointMotion
from mimic.motions.mocap.reading import one_person, with_arm

MAX_POINTS = 2000
_MAX_NAME = 200  # characters
_MAX_VALUE = 1e6  # of a coordinate
_NO_PARENT = -1
_UNSEEN = math.nan, math.nan, math.nan
_SHORTEST = 1e-3  # m; of a link
_CHANGED = 0.3  # of a link's length


class Sample(NamedTuple):
    """Positions of points at one time [s], NaN where a point was not seen; or a hand, None without one."""

    time: float
    points: Mapping[str, Float[np.ndarray, "3"]]
    hand: LiveHand | None = None


def parse_sample(line: bytes) -> Sample:
    """The sample in a line of JSON.

    Raises:
      ValueError: what is wrong with it.
    """
    try:
        content = json.loads(line)
    except (ValueError, RecursionError) as error:
        raise ValueError("expected a line of JSON") from error
    content: dict[str, Any] = content if isinstance(content, dict) else {}
    of_hand = not isinstance(content.get("points"), dict)  # points count first, whatever else a line has
    if of_hand and not isinstance(content.get("hand"), dict):
        raise ValueError("expected an object with 'time' and 'points' or 'hand'")
    time: Any = content.get("time")
    points: dict[str, Any] = {} if of_hand else content["points"]
    if not is_number(time) or not math.isfinite(time):
        raise ValueError("time: expected a finite number of seconds")
    if len(points) > MAX_POINTS or any(len(name) > _MAX_NAME for name in points):
        raise ValueError(f"points: expected at most {MAX_POINTS}, with names of at most {_MAX_NAME} characters")
    positions = np.array([_position(name, point) for name, point in points.items()], float).reshape(-1, 3)
    return Sample(float(time), dict(zip(points, positions, strict=True)), parse_hand(content) if of_hand else None)


def _position(name: str, point: Any) -> tuple[float, float, float]:
    if point is None:
        return _UNSEEN
    if not isinstance(point, list) or len(point) != 3 or not all(map(is_number, point)):
        raise ValueError(f"points: expected three numbers or null for {name!r:.60}")
    x, y, z = point
    if max(abs(x), abs(y), abs(z)) > _MAX_VALUE:
        raise ValueError(f"points: expected coordinates of at most {_MAX_VALUE:g} for {name!r:.60}")
    return x, y, z


def sample_line(sample: Sample) -> bytes:
    """The line of JSON of a sample, with its line break; points that were not seen are null."""
    points = {name: point.tolist() if np.isfinite(point).all() else None for name, point in sample.points.items()}
    return json.dumps({"time": sample.time, "points": points}).encode() + b"\n"


@dataclasses.dataclass(frozen=True)
class LiveArm:
    """An arm of a person whose points arrive one sample at a time.

    Attributes:
      arms: names of the points of the arms that were found.
      side: the arm that is followed, "left" or "right".
      unit: of the points [m].
      up: axis of the points that points up.
      trunk: length of the upright link below the shoulder [m], see `arm_motion`.
      turn: yaw, pitch and roll by which the person is turned [rad], see `turned`.
      zero: frames of the links in the zero pose, see `ball_chain_xml`.
      facing: see `find_facing`. Default None: the shoulders of the arms.
      lengths: of the links [m]; None before they are measured.
    """

    arms: dict[str, ArmPoints]
    side: str
    unit: float
    up: str
    trunk: float
    turn: tuple[float, float, float]
    zero: Float[np.ndarray, "links 3 3"] | None = None
    facing: dict[str, tuple[str, ...]] | None = None
    lengths: Float[np.ndarray, " links"] | None = None

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the points that a sample must have: those of the arm, and those between which the body faces."""
        groups = [*self.arms[self.side][1:], *self._facing.values()]
        return tuple(dict.fromkeys(name for group in groups for name in group))

    @property
    def _facing(self) -> dict[str, tuple[str, ...]]:
        shoulders = {side: arm.shoulder for side, arm in self.arms.items()}
        return self.facing if self.facing is not None else shoulders if len(shoulders) > 1 else {}

    def has_all(self, sample: Sample) -> bool:
        """Whether all points of the arm were seen."""
        return all(name in sample.points and np.isfinite(sample.points[name]).all() for name in self.names)

    def motion(self, samples: Sequence[Sample]) -> LinkMotion:
        """Links of the arm in some samples, without a filter, which would delay them."""
        settings: Any = {"arms": self.arms, "facing": self._facing, "trunk": self.trunk, "cutoff": np.inf}
        links = arm_motion(self._body(samples), self.side, **settings)
        return turned(links, *self.turn)

    def _body(self, samples: Sequence[Sample]) -> PointMotion:
        names = self.names
        positions = np.array([[sample.points[name] for name in names] for sample in samples])
        return PointMotion(names, (_NO_PARENT,) * len(names), z_up(positions, self.up) * self.unit, 1.0)

    def pose(self, sample: Sample) -> Float[np.ndarray, " joints"]:
        """Joint angles of the arm's model in a sample that has all points [rad].

        Raises:
          ValueError: points coincide, so that a link has no direction, or links have other lengths than before.
        """
        assert self.zero is not None, "the arm has no zero pose"
        body, arm = self._body([sample]), self.arms[self.side]
        frames = facing_frames(body, self._facing, np.inf)
        ends = link_ends(body, arm, mean_point(body, arm.shoulder), frames, self.trunk)[0]
        span = np.diff(ends, axis=0) @ turn_matrix(*self.turn).T
        length = np.linalg.norm(span, axis=1, keepdims=True)
        if length.min() < _SHORTEST:
            raise ValueError("points: expected those of a link apart")
        if self.lengths is not None and np.any(np.abs(length[:, 0] - self.lengths) > _CHANGED * self.lengths):
            raise ValueError("points: expected link lengths as in the first samples, got others")
        return ball_chain_pose(span / length, self.zero)


def live_body(
    sample: Sample, unit: str = "", *, up: str = "", subject: str = "", arm: ArmPoints | None = None
) -> PointMotion:
    """The points of a person in a sample, with an arm that is found by their names.

    Args:
      sample: the sample.
      unit: "" for metres, which are then checked against the length of an adult's arm.
      up: axis that points up; "" for z, which is then checked against the body.
      subject, arm: see `read_motion`.

    Raises:
      ValueError: no arm has all names, or the points are not in metres or have another axis up.
    """
    names = tuple(sample.points)
    positions = np.array([[sample.points[name] for name in names]]).reshape(1, len(names), 3)
    body = PointMotion(names, (_NO_PARENT,) * len(names), z_up(positions, up or "z"), 1.0)
    body = with_arm(one_person(body, subject), arm)
    arms = find_arms(body)
    if not arms:
        raise ValueError(f"points: {unnamed(body)}")
    found, how = find_up(body, "z")
    if not up and found != "z":
        raise ValueError(f"points: expected z up, got {found} {how}; capture.up= states it")
    complete = {side: arm for side, arm in arms.items() if np.isfinite(arm_length(body, arm))}
    fitting = guessed_units(body, complete) if complete else ["m"]
    if not unit and fitting != ["m"]:
        lengths = ", ".join(f"{arm_length(body, arm):.4g}" for arm in complete.values())
        known = f"in {' and '.join(fitting)}" if fitting else f"in none of {', '.join(UNITS)}"
        raise ValueError(
            f"points: expected metres, got arms {lengths} long, as an adult's {known}; capture.unit= sets the unit"
        )
    return body
