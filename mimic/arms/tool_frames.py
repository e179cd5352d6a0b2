"""What is at the end of an arm: frames that are fixed to its last link, and the fingers distal of it."""

from collections.abc import Callable, Iterable, Iterator
from typing import NamedTuple

import mujoco
import numpy as np
from jaxtyping import Float

from mimic.arms.model_tree import ancestors, joint_ids, tip_body
from mimic.arms.names import finger_side, is_sensor, tool_rank

# As ints: a MuJoCo enum equals a NumPy integer in one order of the operands and not in the other.
_SLIDE, _SPHERE = int(mujoco.mjtJoint.mjJNT_SLIDE), int(mujoco.mjtGeom.mjGEOM_SPHERE)
_AT_JOINT = 1e-6  # m


class Frame(NamedTuple):
    """A body, site or sphere that is fixed to a link, in the world; the columns of `rotation` are its axes."""

    kind: str
    name: str
    point: Float[np.ndarray, "3"]
    rotation: Float[np.ndarray, "3 3"]

    def __str__(self) -> str:
        return f"{self.kind} {self.name!r}"


class GripperJoint(NamedTuple):
    """A joint of a gripper, in the world. Its sign is that of the middle of its range."""

    axis: Float[np.ndarray, "3"]
    is_slide: bool
    sign: float

    def motion(self, z: Float[np.ndarray, "3"]) -> Float[np.ndarray, "3"]:
        """How it moves a point in front of it along z: across z; 0 where it moves along z, or rotates about it."""
        return self.axis - (self.axis @ z) * z if self.is_slide else np.cross(self.axis, z)


class Finger(NamedTuple):
    """A link that moves distal of an arm and moves no other link.

    Attributes:
      frame: its frame that is farthest from the arm.
      base: [3] point on the axis of the first joint that moves it [m].
      joint: the first joint that moves it.
      has_tip: whether a frame marks its tip.
    """

    frame: Frame
    base: Float[np.ndarray, "3"]
    joint: GripperJoint
    has_tip: bool


class Gripper(NamedTuple):
    """The fingers and joints distal of an arm, none for an arm without; the left finger comes first."""

    fingers: list[Finger]
    joints: list[GripperJoint]

    @property
    def middle(self) -> Float[np.ndarray, "3"]:
        """The mean of the tips of the fingers [m]."""
        return np.mean([finger.frame.point for finger in self.fingers], axis=0)


NO_GRIPPER = Gripper([], [])


def fixed_frames(model: mujoco.MjModel, data: mujoco.MjData, body: int) -> Iterator[Frame]:
    """The sites and bodies that are fixed to a body, itself left out, and spheres that mark a tool by their name."""
    for site in range(model.nsite):
        if model.body_weldid[model.site_bodyid[site]] == body:
            yield _site_frame(model, data, site)
    for other in range(body + 1, model.nbody):
        if model.body_weldid[other] == body:
            yield body_frame(model, data, other)
    for geom in np.flatnonzero(model.geom_type == _SPHERE):
        name = model.geom(geom).name
        if model.body_weldid[model.geom_bodyid[geom]] == body and tool_rank(name) is not None:
            yield Frame("sphere", name, data.geom_xpos[geom], data.geom_xmat[geom].reshape(3, 3))


def find_frame(model: mujoco.MjModel, data: mujoco.MjData, name: str) -> Frame:
    """The frame of the site or body with a name, which the model has; see `tip_body`."""
    site = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_SITE, name)
    return _site_frame(model, data, site) if site >= 0 else body_frame(model, data, tip_body(model, name))


def best_frame(frames: Iterable[Frame], rank: Callable[[str], int | None], anchor: np.ndarray) -> Frame | None:
    """The frame with the most telling name; of several, the one that is farthest from a point."""
    ranked = [(place, -distance(frame.point, anchor), frame) for frame in frames
              if (place := rank(frame.name)) is not None]  # fmt: skip
    return min(ranked, key=lambda entry: entry[:2])[2] if ranked else None


def named_frame(model: mujoco.MjModel, body: int, rank: Callable[[str], int | None] = tool_rank) -> str | None:
    """Name of the frame that is fixed to a body and named as tools are, or ranked highest; None where there is none."""
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    frame = best_frame(fixed_frames(model, data, body), rank, data.xpos[body])
    return frame.name if frame else None


def find_gripper(model: mujoco.MjModel, data: mujoco.MjData, last: int, anchor: np.ndarray) -> Gripper:
    """What moves distal of the last body of an arm, whose last joint is at a point."""
    distal = [body for body in range(last + 1, model.nbody) if last in ancestors(model, body)]
    moving = [body for body in distal if model.body_jntnum[body] and not is_sensor(model.body(body).name)]
    parents = {int(model.body_weldid[model.body_parentid[body]]) for body in moving}
    fingers = []
    for body in (body for body in moving if body not in parents):
        frames = [body_frame(model, data, body), *fixed_frames(model, data, body)]
        farthest = max(frames, key=lambda frame: distance(frame.point, anchor))
        first = next(part for part in moving if part in ancestors(model, body))
        root, own = (int(model.body_jntadr[part]) for part in (first, body))
        has_tip = distance(farthest.point, data.xanchor[own]) > _AT_JOINT
        fingers.append(Finger(farthest, data.xanchor[root], _joint(model, data, root), has_tip))
    fingers.sort(key=lambda finger: finger_side(finger.frame.name) != "left")  # stable
    joints = [_joint(model, data, joint) for body in moving for joint in joint_ids(model, body)]
    return Gripper(fingers, joints)


def _joint(model: mujoco.MjModel, data: mujoco.MjData, joint: int) -> GripperJoint:
    is_slide = int(model.jnt_type[joint]) == _SLIDE
    return GripperJoint(data.xaxis[joint], is_slide, float(np.sign(model.jnt_range[joint].sum())))


def _site_frame(model: mujoco.MjModel, data: mujoco.MjData, site: int) -> Frame:
    return Frame("site", model.site(site).name, data.site_xpos[site], data.site_xmat[site].reshape(3, 3))


def body_frame(model: mujoco.MjModel, data: mujoco.MjData, body: int) -> Frame:
    """The frame of a body."""
    return Frame("body", model.body(body).name, data.xpos[body], data.xmat[body].reshape(3, 3))


def distance(point: np.ndarray, other: np.ndarray) -> float:
    """Distance of two points."""
    return float(np.linalg.norm(point - other))
