"""An arm of a pose mapper by its name, its file or its config: its own joints, and the numbers that a network takes."""

import dataclasses
import os
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from mimic.arms.arm import Arm, ArmConfig, build_arm
from mimic.arms.arrays import MAX_JOINTS, MAX_LINKS, ArmArrays, arm_arrays, masked_arrays
from mimic.arms.embodiment import Embodiment
from mimic.envs import env_config, environments
from mimic.envs.config import EnvConfig

NamedArm = Arm | ArmConfig | str | os.PathLike[str]


@dataclasses.dataclass(frozen=True, eq=False)
class MapperArm:
    """An arm whose poses have an angle for each of its own joints, and its data, whose poses may have more.

    Attributes:
      embodiment: with its own joints; those that are locked are not among them. None where only the data are known.
      data: the embodiment as a constant, or arrays in single precision.
      joints: place of each of the own joints in a pose of the data.
      slots: names of the first joints of such a pose, locked ones included.
    """

    embodiment: Any
    data: Any
    joints: Int[np.ndarray, " joints"]
    slots: tuple[str, ...]

    @classmethod
    def constant(cls, embodiment: Embodiment) -> "MapperArm":
        """An arm that a function is compiled for."""
        return cls(embodiment, embodiment, np.arange(embodiment.num_joints), embodiment.joint_names)

    @classmethod
    def without_locks(cls, arm: Arm) -> "MapperArm":
        """An arm as arrays whose locked joints have no slot."""
        arrays, names = arm_arrays(arm).astype(np.float32), arm.embodiment.joint_names
        return cls(arm.embodiment, arrays, np.arange(len(names)), names)

    def in_slots(self, qpos: Float[Array, "*batch joints"]) -> Float[Array, "*batch slots"]:
        """Poses of the data from those of the own joints [rad]: home in the other slots."""
        if not isinstance(self.data, ArmArrays):
            return qpos
        own = len(self.joints)
        source = own + np.arange(MAX_JOINTS)
        source[self.joints] = np.arange(own)
        home = jnp.broadcast_to(jnp.asarray(self.data.home, qpos.dtype), (*qpos.shape[:-1], MAX_JOINTS))
        return jnp.concatenate([qpos, home], axis=-1)[..., source]  # exported functions have no scatter

    def own_joints(self, qpos: Float[Array, "*batch slots"]) -> Float[Array, "*batch joints"]:
        """Poses of the own joints from those of the data [rad]."""
        return qpos[..., self.joints] if isinstance(self.data, ArmArrays) else qpos


def describe_arm(env: EnvConfig, arm: NamedArm) -> MapperArm:
    """An arm as arrays. Joints that a config locks are locked by the mask, as in training.

    Args:
      env: the environment, whose `limits` and `metric.links` the arm is built with.
      arm: the arm, see `PoseMapper.__call__`.

    Raises:
      ValueError: see `PoseMapper.__call__`.
    """
    limits, links = env.limits, env.metric.links
    if isinstance(arm, Arm):
        return MapperArm.without_locks(arm)
    if isinstance(arm, ArmConfig):
        config = arm
    else:
        name = os.fspath(arm)
        config = env_config(name).learner if name in environments() else ArmConfig(model=name)
    built = build_arm(config, limits, links)
    whole = build_arm(dataclasses.replace(config, locked=None), limits, links) if built.locked else built
    if max(whole.embodiment.num_joints - MAX_JOINTS, whole.embodiment.num_links - MAX_LINKS) > 0:
        return MapperArm.without_locks(built)  # it may have few enough without those that are locked
    arrays, names = masked_arrays(config, limits, links)
    is_free = np.asarray(arrays.is_free) > 0
    return MapperArm(built.embodiment, arrays.astype(np.float32), np.flatnonzero(is_free), names)
