"""The description of an arm as one vector: the kinematics in `ArmArrays`, for exported networks and other programs."""

import json
import math
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from mimic.any_arm.arrays import MAX_JOINTS, MAX_LINKS, ArmArrays
from mimic.runs.files import write_atomically

# Shapes of the fields of `ArmArrays` that a pose depends on, in the order of the vector.
_SHAPES: dict[str, tuple[int, ...]] = {
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
}
SIZE = sum(map(math.prod, _SHAPES.values()))
SUFFIXES = (".json", ".npz")


def description_layout() -> list[dict[str, Any]]:
    """Name, start, stop and shape of each part of the vector, in its order; what they are: see `ArmArrays`."""
    layout, start = [], 0
    for name, shape in _SHAPES.items():
        layout.append({"name": name, "start": start, "stop": start + math.prod(shape), "shape": list(shape)})
        start = layout[-1]["stop"]
    return layout


def description(arm: ArmArrays) -> Float[np.ndarray, " numbers"]:
    """The vector of an arm, in single precision."""
    return np.concatenate([np.ravel(getattr(arm, name)) for name in _SHAPES]).astype(np.float32)


def described_arm(vector: Float[Array, " numbers"]) -> ArmArrays:
    """The arm of a vector, with masses of 0 and limits of 1."""
    parts: dict[str, Any] = {
        part["name"]: vector[part["start"] : part["stop"]].reshape(part["shape"]) for part in description_layout()
    }
    parts["link_joint"] = jnp.round(parts["link_joint"]).astype(jnp.int32)
    none, one = jnp.zeros(MAX_JOINTS, vector.dtype), jnp.ones(MAX_JOINTS, vector.dtype)
    return ArmArrays(
        **parts,
        first_moment=jnp.zeros((MAX_JOINTS, 2), vector.dtype),
        second_moment=jnp.zeros((MAX_JOINTS, 5), vector.dtype),
        armature=one,
        damping=none,
        velocity_limit=one,
        torque_limit=one,
    )


def save_description(file: Path, arm: ArmArrays, name: str, joints: tuple[str, ...]) -> None:
    """Writes the vector of an arm, its layout and the names of its joints to a .json or .npz file.

    Args:
      file: the file.
      arm: the arm.
      name: of the arm.
      joints: name of the joint in each slot, locked ones included.

    Raises:
      ValueError: another suffix.
    """
    if file.suffix not in SUFFIXES:
        raise ValueError(f"{str(file)!r}: expected a file {' or '.join(SUFFIXES)} for the description of an arm")
    vector, layout = description(arm), description_layout()
    if file.suffix == ".npz":
        with file.open("wb") as opened:
            np.savez(opened, learner=vector, name=name, joints=np.array(joints), layout=json.dumps(layout))
        return
    content = {"name": name, "joints": list(joints), "learner": [float(x) for x in vector], "layout": layout}
    write_atomically(file, json.dumps(content, indent=2) + "\n")
