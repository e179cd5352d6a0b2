"""Joints and objects of robosuite's simulations, from flattened states and the model that they are of."""

from collections.abc import Sequence
from xml.etree import ElementTree

import mujoco
import numpy as np
from jaxtyping import Float

_MAX_ELEMENTS = 10_000  # of a model
# What places bodies; all else, such as meshes that are not beside the file, is left out.
_KEPT = {
    "mujoco": (),
    "compiler": ("angle", "eulerseq"),
    "default": ("class",),
    "worldbody": (),
    "body": ("name", "childclass", "pos", "quat", "euler", "axisangle", "xyaxes", "zaxis"),
    "joint": ("name", "class", "type", "pos", "axis", "ref"),
    "freejoint": ("name",),
}


def skeleton(xml: str) -> mujoco.MjModel:
    """The bodies and joints of a model, without shapes.

    Raises:
      ValueError: MuJoCo cannot compile them, there are too many, or a document type is declared.
      ElementTree.ParseError: it is no XML.
    """
    if "<!" in xml.replace("<!--", ""):
        raise ValueError("the model declares a document type, expected elements alone")
    root = ElementTree.fromstring(xml)
    if sum(1 for _ in root.iter()) > _MAX_ELEMENTS:
        raise ValueError(f"the model has more than {_MAX_ELEMENTS:,} elements")
    bare = _bare(root)
    ElementTree.SubElement(bare, "compiler", boundmass="1", boundinertia="1")
    return mujoco.MjModel.from_xml_string(ElementTree.tostring(bare, encoding="unicode"))


def _bare(element: ElementTree.Element) -> ElementTree.Element:
    """An element with what is kept of it and of those in it."""
    kept = _KEPT.get(element.tag, ())
    bare = ElementTree.Element(element.tag, {key: text for key, text in element.items() if key in kept})
    bare.extend([_bare(child) for child in element if child.tag in _KEPT])
    return bare


def object_poses(
    model: mujoco.MjModel, states: Float[np.ndarray, "samples width"], arm: Sequence[int]
) -> Float[np.ndarray, "samples objects 4 4"] | None:
    """The poses of all bodies that joints move and that are no part of the arm, in the arm's base frame [m].

    The base frame is that of the body from which the first joint starts.

    Args:
      model: see `skeleton`.
      states: of the simulation: time, qpos and qvel.
      arm: numbers of the arm's joints, base to tip.

    Returns:
      None where there is no such body, and where states are not finite.
    """
    own = model.jnt_bodyid[list(arm)]
    is_arm = np.isin(model.body_rootid, model.body_rootid[own])
    objects = np.flatnonzero((model.body_jntnum > 0) & ~is_arm)
    if not len(objects) or not np.isfinite(states).all():
        return None
    data, bodies = mujoco.MjData(model), [model.body_parentid[own[0]], *objects]
    poses = np.tile(np.eye(4), (len(states), len(bodies), 1, 1))
    for pose, state in zip(poses, states, strict=True):
        data.qpos[:] = state[1 : 1 + model.nq]
        mujoco.mj_kinematics(model, data)
        pose[:, :3, :3], pose[:, :3, 3] = data.xmat[bodies].reshape(-1, 3, 3), data.xpos[bodies]
    return np.linalg.inv(poses[:, :1]) @ poses[:, 1:]
