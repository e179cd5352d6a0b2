"""Bodies and joints of a MuJoCo model by id: the tree that they form, and their names."""

from collections.abc import Callable
from typing import Any

import mujoco
import numpy as np
from jaxtyping import Float

from mimic.base.config import suggestion

# As ints: a MuJoCo enum equals a NumPy integer in one order of the operands and not in the other.
_REVOLUTE, _SLIDE = int(mujoco.mjtJoint.mjJNT_HINGE), int(mujoco.mjtJoint.mjJNT_SLIDE)
_KINDS = {int(kind): kind.name.removeprefix("mjJNT_").lower() for kind in mujoco.mjtJoint.__members__.values()}


def joint_kind(model: mujoco.MjModel, joint: int) -> str:
    """MuJoCo's name of a joint's type: hinge, slide, ball or free."""
    return _KINDS[int(model.jnt_type[joint])]


def joint_ids(model: mujoco.MjModel, body: int) -> range:
    """Joints of a body, in order."""
    return range(model.body_jntadr[body], model.body_jntadr[body] + model.body_jntnum[body])


def is_revolute(model: mujoco.MjModel, joint: int) -> bool:
    """Whether a joint is revolute (MuJoCo: hinge), and not that of a base that also slides along two axes."""
    of_body = joint_ids(model, int(model.jnt_bodyid[joint]))
    slides = sum(int(model.jnt_type[other]) == _SLIDE for other in of_body)
    return int(model.jnt_type[joint]) == _REVOLUTE and slides < 2


def ancestors(model: mujoco.MjModel, body: int) -> list[int]:
    """The body, its parent, … and the world."""
    line = [int(body)]
    while line[-1] != 0:
        line.append(int(model.body_parentid[line[-1]]))
    return line


def body_id(model: mujoco.MjModel, base: str) -> int:
    """Id of the body with a name.

    Raises:
      ValueError: no body has this name.
    """
    body = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_BODY, base)
    if body < 0:
        raise _unknown("base: expected a body of the model", base, _names(model.body, range(1, model.nbody)))
    return body


def tip_body(model: mujoco.MjModel, tip: str) -> int:
    """Id of the body with a name, or of the body with the site of this name.

    Raises:
      ValueError: no body or site has this name.
    """
    site = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_SITE, tip)
    body = int(model.site_bodyid[site]) if site >= 0 else mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_BODY, tip)
    if body < 0:
        names = [*_names(model.body, range(1, model.nbody)), *_names(model.site, range(model.nsite))]
        raise _unknown("tip: expected a body or site of the model", tip, names)
    return body


def _names(named: Callable[[int], Any], ids: range) -> list[str]:
    return [name for name in (named(index).name for index in ids) if name]


def _unknown(expected: str, name: str, valid: list[str]) -> ValueError:
    choices = ", ".join(dict.fromkeys(valid)) or "none, as it names none"
    return ValueError(f"{expected}, {choices}, got {name!r:.80}{suggestion(name, valid)}")


def quaternion(rotation: Float[np.ndarray, "3 3"]) -> Float[np.ndarray, "4"]:
    """Quaternion (w, x, y, z) of a rotation."""
    wxyz = np.zeros(4)
    mujoco.mju_mat2Quat(wxyz, np.ascontiguousarray(rotation, float).ravel())
    return wxyz
