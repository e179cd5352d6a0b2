"""Where an arm ends: at its tool, between its fingers, or at its last joint; never by meshes.

The one place that chooses it: the last link ends there, and joints distal of it are the gripper's.
"""

from collections.abc import Callable, Iterable, Iterator
from typing import NamedTuple

import mujoco
import numpy as np
from jaxtyping import Float

from mimic.arms.names import hand_rank, is_sensor, tool_rank

# As ints: a MuJoCo enum equals a NumPy integer in one order of the operands and not in the other.
_CAPSULE, _CYLINDER, _MESH = (
    int(kind) for kind in (mujoco.mjtGeom.mjGEOM_CAPSULE, mujoco.mjtGeom.mjGEOM_CYLINDER, mujoco.mjtGeom.mjGEOM_MESH)
)
_AT_JOINT = 1e-6  # m


class Frame(NamedTuple):
    """A body or site that is fixed to a link."""

    kind: str
    name: str
    point: Float[np.ndarray, "3"]

    def __str__(self) -> str:
        return f"{self.kind} {self.name!r}"


class ArmEnd(NamedTuple):
    """The end of an arm in the zero pose: a point in the world [m], and what it is, in words."""

    point: Float[np.ndarray, "3"]
    reason: str


def find_end(model: mujoco.MjModel, data: mujoco.MjData, joint: int) -> ArmEnd:
    """The end of an arm whose last joint is given.

    In this order: a frame that is named as tools are; the mean of the tips of its fingers; a frame that is named as
    hands are; a single finger; the farthest other frame that is not a sensor's; the farthest end of a simple shape; the
    joint itself.

    Args:
      model: with the arm.
      data: its kinematics in the zero pose.
      joint: id of the last joint.
    """
    last, anchor = int(model.jnt_bodyid[joint]), data.xanchor[joint]
    frames = list(_frames(model, data, last))
    if tool := _best(frames, tool_rank, anchor):
        return ArmEnd(tool.point, f"{tool}, named as tools are")
    tips = _finger_tips(model, data, last, anchor)
    if len(tips) > 1:
        return ArmEnd(np.mean([tip.point for tip in tips], axis=0), f"between {', '.join(map(str, tips))}")
    if hand := _best(frames, hand_rank, anchor):
        return ArmEnd(hand.point, f"{hand}, named as hands are")
    if tips:
        return ArmEnd(tips[0].point, f"{tips[0]}, a finger")
    others = [frame for frame in frames if not is_sensor(frame.name) and _distance(frame.point, anchor) > _AT_JOINT]
    if others:
        farthest = max(others, key=lambda frame: _distance(frame.point, anchor))
        return ArmEnd(farthest.point, f"{farthest}, the farthest frame of the last link")
    shapes = max(_shape_ends(model, data, last), key=lambda point: _distance(point, anchor), default=anchor)
    if _distance(shapes, anchor) > _AT_JOINT:
        return ArmEnd(shapes, "the farthest end of the shapes of the last link")
    return ArmEnd(anchor, f"joint {model.joint(joint).name!r}, as no frame is fixed to the last link")


def named_frame(model: mujoco.MjModel, body: int, rank: Callable[[str], int | None] = tool_rank) -> str | None:
    """Name of the frame that is fixed to a body and named as tools are, or ranked highest; None where there is none."""
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    frame = _best(_frames(model, data, body), rank, data.xpos[body])
    return frame.name if frame else None


def _frames(model: mujoco.MjModel, data: mujoco.MjData, body: int) -> Iterator[Frame]:
    """The sites and bodies that are fixed to a body, in the order of the model."""
    for site in range(model.nsite):
        if model.body_weldid[model.site_bodyid[site]] == body:
            yield Frame("site", model.site(site).name, data.site_xpos[site])
    for other in range(body + 1, model.nbody):
        if model.body_weldid[other] == body:
            yield Frame("body", model.body(other).name, data.xpos[other])


def _best(frames: Iterable[Frame], rank: Callable[[str], int | None], anchor: np.ndarray) -> Frame | None:
    """The frame with the most telling name; of several, the farthest."""
    ranked = [(place, -_distance(frame.point, anchor), frame) for frame in frames
              if (place := rank(frame.name)) is not None]  # fmt: skip
    return min(ranked, key=lambda entry: entry[:2])[2] if ranked else None


def _finger_tips(model: mujoco.MjModel, data: mujoco.MjData, body: int, anchor: np.ndarray) -> list[Frame]:
    """The farthest frame of each link that moves distal of a body and moves no other link."""
    distal = [part for part in _distal(model, body) if model.body_jntnum[part] and not is_sensor(model.body(part).name)]
    moving = {part: int(model.body_weldid[model.body_parentid[part]]) for part in distal}
    tips = []
    for finger in (part for part in distal if part not in moving.values()):
        frames = [Frame("body", model.body(finger).name, data.xpos[finger]), *_frames(model, data, finger)]
        tips.append(max(frames, key=lambda frame: _distance(frame.point, anchor)))
    return tips


def _distal(model: mujoco.MjModel, body: int) -> list[int]:
    """The bodies distal of a body, each after its parent."""
    distal = {body}
    for other in range(body + 1, model.nbody):  # children come after their parents
        if int(model.body_parentid[other]) in distal:
            distal.add(other)
    return sorted(distal - {body})


def _shape_ends(model: mujoco.MjModel, data: mujoco.MjData, body: int) -> Iterator[np.ndarray]:
    """Both ends of each capsule and cylinder that is fixed to a body, and the centres of other shapes but meshes."""
    for geom in range(model.ngeom):
        if model.body_weldid[model.geom_bodyid[geom]] == body and model.geom_type[geom] != _MESH:
            is_rod = model.geom_type[geom] in (_CAPSULE, _CYLINDER)
            half = data.geom_xmat[geom].reshape(3, 3)[:, 2] * (model.geom_size[geom, 1] if is_rod else 0)
            yield from (data.geom_xpos[geom] + half, data.geom_xpos[geom] - half)


def _distance(point: np.ndarray, anchor: np.ndarray) -> float:
    return float(np.linalg.norm(point - anchor))
