"""Poses of the objects in robosuite's simulations, from flattened states and the model that they are of."""

from collections.abc import Iterator, Mapping, Sequence
from xml.etree.ElementTree import Element

import numpy as np
from jaxtyping import Float

JOINTS = "joint", "freejoint"
_OTHER_ROTATIONS = "euler", "axisangle", "xyaxes", "zaxis"  # of bodies, which robosuite does not use

_Poses = Float[np.ndarray, "samples 4 4"]


def object_poses(
    model: Element, columns: Mapping[str, int], states: Float[np.ndarray, "samples width"], joints: Sequence[str]
) -> Float[np.ndarray, "samples objects 4 4"] | None:
    """The poses of all bodies that joints move and that are no part of the arm, in the arm's base frame.

    The base frame is that of the body from which the first joint starts.

    Args:
      model: MuJoCo's, with angles in radians.
      columns: of the states, where each joint begins, by name.
      states: of the simulation.
      joints: names of the arm's joints, base to tip.

    Returns:
      None where there is no such body, where states are not finite, and where the model has what is not computed here.
    """
    if any(body.get(key) for body in model.iter("body") for key in _OTHER_ROTATIONS):
        return None
    base, objects = None, []
    free = [columns.get(joint.get("name", ""), 0) for joint in model.iter() if _is_free(joint)]
    if not np.isfinite(states).all():
        return None
    if any(not np.all(np.linalg.norm(states[:, first + 3 : first + 7], axis=1) > 0) for first in free):
        return None  # no rotation
    for tree in (tree for world in model.findall("worldbody") for tree in world.findall("body")):
        is_arm = bool({joint.get("name") for joint in tree.iter("joint")} & set(joints))
        if not is_arm and any(joint.get("type") == "ball" or joint.get("class") for joint in tree.iter("joint")):
            return None
        for body, parent, pose in _bodies(tree, np.tile(np.eye(4), (len(states), 1, 1)), columns, states):
            names = [child.get("name", "") for child in body if child.tag in JOINTS]
            if any(name not in columns for name in names):
                return None
            base = parent if joints[0] in names else base
            objects += [pose] * bool(names and not is_arm)
    return np.linalg.inv(base)[:, None] @ np.stack(objects, axis=1) if base is not None and objects else None


def _bodies(
    body: Element, parent: _Poses, columns: Mapping[str, int], states: np.ndarray
) -> Iterator[tuple[Element, _Poses, _Poses]]:
    """A body and those below it, each with the pose of its parent and its own, in the world."""
    pose = parent @ _pose(_numbers(body, "pos", 3), _numbers(body, "quat", 4, (1, 0, 0, 0)))
    for joint in (child for child in body if child.tag in JOINTS and child.get("name", "") in columns):
        first, kind = columns[joint.get("name", "")], joint.get("type", "hinge")
        if _is_free(joint):
            pose = _pose(states[:, first : first + 3], states[:, first + 3 : first + 7])
            continue
        axis, angle = _numbers(joint, "axis", 3, (0, 0, 1)), states[:, first, None]
        axis = axis / np.linalg.norm(axis)
        if kind == "slide":
            pose = pose @ _pose(angle * axis, np.array([1.0, 0, 0, 0]))
        elif kind == "hinge":
            anchor = _numbers(joint, "pos", 3)
            turn = np.concatenate([np.cos(angle / 2), np.sin(angle / 2) * axis], axis=1)
            pose = pose @ _pose(anchor, np.array([1.0, 0, 0, 0])) @ _pose(np.zeros(3), turn)
            pose = pose @ _pose(-anchor, np.array([1.0, 0, 0, 0]))
    yield body, parent, pose
    for child in body.findall("body"):
        yield from _bodies(child, pose, columns, states)


def _is_free(joint: Element) -> bool:
    return joint.tag == "freejoint" or (joint.tag == "joint" and joint.get("type") == "free")


def _numbers(element: Element, name: str, count: int, default: Sequence[float] = (0, 0, 0)) -> np.ndarray:
    """An attribute with some numbers."""
    numbers = np.array([float(number) for number in element.get(name, "").split()] or default, float)
    if numbers.shape != (count,):
        raise ValueError(f"the model: expected {count} numbers as {name}, got {element.get(name)!r}")
    return numbers


def _pose(position: Float[np.ndarray, "*samples 3"], quaternion: Float[np.ndarray, "*samples 4"]) -> np.ndarray:
    """Homogeneous matrices [*samples, 4, 4]; quaternions are wxyz."""
    w, x, y, z = np.moveaxis(quaternion / np.linalg.norm(quaternion, axis=-1, keepdims=True), -1, 0)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    rotation = np.moveaxis(np.array(rows), (0, 1), (-2, -1))
    pose = np.zeros((*np.broadcast_shapes(position.shape[:-1], rotation.shape[:-2]), 4, 4)) + np.eye(4)
    pose[..., :3, :3], pose[..., :3, 3] = rotation, position
    return pose
