"""Drawing of planar arms, shared by all figures."""

from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from mimic.arms.embodiment import Embodiment
from mimic.metric.kinematics import forward_kinematics

EXPERT_COLOUR, LEARNER_COLOUR = "tab:blue", "tab:orange"


def joint_points(arm: Embodiment, qpos: Any) -> Float[np.ndarray, "points 2"]:
    """Positions of base, joints and tip of a planar arm, scaled to chain length 1."""
    direction = np.asarray(forward_kinematics(arm, jnp.asarray(qpos)).rotation)[:, :2, 0]
    ends = np.cumsum(direction * np.asarray(arm.link_lengths)[:, None], axis=0)
    return np.concatenate([np.zeros((1, 2)), ends]) / float(arm.chain_length)


def draw_arm(
    axes: Any, arm: Embodiment, qpos: Any, colour: str, label: str, *, width: float = 3, alpha: float = 1
) -> None:
    """Draws a planar arm, scaled to chain length 1."""
    style: dict[str, Any] = {"color": colour, "lw": width, "ms": width + 2, "alpha": alpha, "solid_capstyle": "round"}
    axes.plot(*joint_points(arm, qpos).T, "-o", label=label, **style)
