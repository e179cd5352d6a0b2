"""The description of an arm as one vector, the numbers of `ArmArrays`, for exported networks and other programs."""

import json
import math
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from mimic.arms.arrays import MAX_JOINTS, MAX_LINKS, ArmArrays
from mimic.base.files import write_atomically

# Shapes of the fields of `ArmArrays` that a pose depends on, in the order of the vector; and of the other fields.
_KINEMATICS: dict[str, tuple[int, ...]] = {
    "base_rotation": (3, 3),
    "base_position": (3,),
    "twist": (MAX_JOINTS, 2),
    "offset": (MAX_JOINTS, 2),
    "reference": (MAX_JOINTS,),
    "is_free": (MAX_JOINTS,),
    "home": (MAX_JOINTS,),
    "joint_range": (MAX_JOINTS, 2),
    "link_joint": (MAX_LINKS,),
    "link_position": (MAX_LINKS, 3),
    "link_direction": (MAX_LINKS, 3),
    "link_length": (MAX_LINKS,),
    "hand_joint": (),
    "hand_position": (3,),
    "hand_rotation": (3, 3),
}
_DYNAMICS: dict[str, tuple[int, ...]] = {
    "first_moment": (MAX_JOINTS, 2),
    "second_moment": (MAX_JOINTS, 5),
    "armature": (MAX_JOINTS,),
    "damping": (MAX_JOINTS,),
    "velocity_limit": (MAX_JOINTS,),
    "torque_limit": (MAX_JOINTS,),
}
SUFFIX = ".json"


def description_layout(*, has_dynamics: bool = False) -> list[dict[str, Any]]:
    """Name, start, stop and shape of each part of the vector, in its order; what they are: see `ArmArrays`."""
    layout, start = [], 0
    for name, shape in (_KINEMATICS | _DYNAMICS if has_dynamics else _KINEMATICS).items():
        layout.append({"name": name, "start": start, "stop": start + math.prod(shape), "shape": list(shape)})
        start = layout[-1]["stop"]
    return layout


def description_size(*, has_dynamics: bool = False) -> int:
    """Length of the vector."""
    return description_layout(has_dynamics=has_dynamics)[-1]["stop"]


def description(arm: ArmArrays, *, has_dynamics: bool = False) -> Float[np.ndarray, " numbers"]:
    """The vector of an arm, in single precision: the kinematics, and the dynamics after it where they are asked for."""
    parts = [np.ravel(getattr(arm, part["name"])) for part in description_layout(has_dynamics=has_dynamics)]
    return np.concatenate(parts).astype(np.float32)


def described_arm(vector: Float[Array, " numbers"]) -> ArmArrays:
    """The arm of a vector; of one without dynamics, with masses of 0 and limits of 1."""
    has_dynamics = len(vector) == description_size(has_dynamics=True)
    none, one = jnp.zeros(MAX_JOINTS, vector.dtype), jnp.ones(MAX_JOINTS, vector.dtype)
    parts: dict[str, Any] = {
        "first_moment": jnp.zeros((MAX_JOINTS, 2), vector.dtype),
        "second_moment": jnp.zeros((MAX_JOINTS, 5), vector.dtype),
        "armature": one,
        "damping": none,
        "velocity_limit": one,
        "torque_limit": one,
    }
    for part in description_layout(has_dynamics=has_dynamics):
        parts[part["name"]] = vector[part["start"] : part["stop"]].reshape(part["shape"])
    parts |= {name: jnp.round(parts[name]).astype(jnp.int32) for name in ("link_joint", "hand_joint")}
    return ArmArrays(**parts)


def save_description(
    file: Path, arm: ArmArrays, name: str, joints: tuple[str, ...], *, has_dynamics: bool = False
) -> None:
    """Writes the vector of an arm, its layout and the names of its joints to a .json file.

    The file gets its name when it is complete.

    Args:
      file: the file.
      arm: the arm.
      name: of the arm.
      joints: name of the joint in each slot, locked ones included.
      has_dynamics: whether the vector has the dynamics and the limits too.

    Raises:
      ValueError: another suffix.
    """
    if file.suffix != SUFFIX:
        raise ValueError(f"{str(file)!r}: expected a file {SUFFIX} for the description of an arm")
    vector = description(arm, has_dynamics=has_dynamics)
    layout = description_layout(has_dynamics=has_dynamics)
    content = {"name": name, "joints": list(joints), "learner": [float(x) for x in vector], "layout": layout}
    write_atomically(file, json.dumps(content, indent=2) + "\n")
