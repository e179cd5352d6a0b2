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


def description_layout() -> list[dict[str, Any]]:
    """Name, start, stop and shape of each part of the vector, in its order; what they are: see `ArmArrays`."""
    layout, start = [], 0
    for name, shape in _KINEMATICS.items():
        layout.append({"name": name, "start": start, "stop": start + math.prod(shape), "shape": list(shape)})
        start = layout[-1]["stop"]
    return layout


def description_size() -> int:
    """Length of the vector."""
    return description_layout()[-1]["stop"]


def description(arm: ArmArrays) -> Float[np.ndarray, " numbers"]:
    """The vector of an arm's kinematics, in single precision."""
    return np.concatenate([np.ravel(getattr(arm, name)) for name in _KINEMATICS]).astype(np.float32)


def described_arm(vector: Float[Array, " numbers"]) -> ArmArrays:
    """The arm of a vector, with dynamics of 0."""
    parts: dict[str, Any] = {name: jnp.zeros(shape, vector.dtype) for name, shape in _DYNAMICS.items()}
    for part in description_layout():
        parts[part["name"]] = vector[part["start"] : part["stop"]].reshape(part["shape"])
    parts |= {name: jnp.round(parts[name]).astype(jnp.int32) for name in ("link_joint", "hand_joint")}
    return ArmArrays(**parts)


def save_description(file: Path, arm: ArmArrays, name: str, joints: tuple[str, ...]) -> None:
    """Writes the vector of an arm, its layout and the names of its joints to a .json file.

    The file gets its name when it is complete.

    Args:
      file: the file.
      arm: the arm.
      name: of the arm.
      joints: name of the joint in each slot, locked ones included.

    Raises:
      ValueError: another suffix.
    """
    if file.suffix != SUFFIX:
        raise ValueError(f"{str(file)!r}: expected a file {SUFFIX} for the description of an arm")
    vector = [float(x) for x in description(arm)]
    content = {"name": name, "joints": list(joints), "learner": vector, "layout": description_layout()}
    write_atomically(file, json.dumps(content, indent=2) + "\n")
