"""The start pose of an arm that its config states: angles, or a keyframe of its model."""

import dataclasses
import math
from collections.abc import Mapping, Sequence
from typing import Any

import mujoco

from mimic.arms.chain import Joint, find_joint
from mimic.base.config import suggestion

_ROUNDING = 1e-3  # rad; files round angles at the end of a range


def with_home(joints: Sequence[Joint], home: Any, model: mujoco.MjModel) -> tuple[Joint, ...]:
    """The joints with another start pose.

    Args:
      joints: of the chain, locked ones included.
      home: see `ArmConfig`.
      model: that the chain was read from.

    Raises:
      ValueError: a keyframe or joint that the model lacks, another number of angles than joints, or an angle that is
        no number or outside of its joint's range.
    """
    names = tuple(joint.name for joint in joints)
    angles = _keyframe(names, home, model) if isinstance(home, str) else _angles(names, home)
    return tuple(_with_angle(joint, angles.get(joint.name, joint.home)) for joint in joints)


def _angles(names: tuple[str, ...], home: Any) -> dict[str, Any]:
    if isinstance(home, Mapping):
        return {find_joint(joint, names, "home"): angle for joint, angle in home.items()}
    if not isinstance(home, Sequence) or len(home) != len(names):
        raise ValueError(
            f"home: expected {len(names)} angles [rad], one for each of {', '.join(names)}, a mapping from joints to "
            f"angles, or the name of a keyframe, got {home!r:.80}"
        )
    return dict(zip(names, home, strict=True))


def _keyframe(names: tuple[str, ...], key: str, model: mujoco.MjModel) -> dict[str, Any]:
    keys = [model.key(index).name for index in range(model.nkey)]
    if key not in keys:
        valid = ", ".join(filter(None, keys)) or "none, the model has no keyframe with a name"
        raise ValueError(f"home: unknown keyframe {key!r:.80}; valid are {valid}{suggestion(key, keys)}")
    pose = model.key(keys.index(key)).qpos
    addresses = {model.joint(index).name: model.jnt_qposadr[index] for index in range(model.njnt)}
    return {name: float(pose[addresses[name]]) for name in names}


def _with_angle(joint: Joint, angle: Any) -> Joint:
    low, high = joint.range
    is_number = isinstance(angle, int | float) and not isinstance(angle, bool) and math.isfinite(angle)
    if not is_number or not low - _ROUNDING <= angle <= high + _ROUNDING:
        raise ValueError(f"home: {joint.name}: expected an angle from {low:.4g} to {high:.4g} rad, got {angle!r:.80}")
    return dataclasses.replace(joint, home=min(max(float(angle), low), high))
