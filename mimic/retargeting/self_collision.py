"""Motions in which links touch each other or the floor."""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from mimic.arms.capsules import Capsules
from mimic.arms.embodiment import Embodiment
from mimic.retargeting.clearance import make_clearance


def smallest_clearances(
    arm: Embodiment, capsules: Capsules, qpos: Float[np.ndarray, "motions time joints"], floor_height: float = 0.0
) -> Float[np.ndarray, " motions"]:
    """The smallest clearance of each motion [m], negative where capsules of links touch each other or the floor.

    Args:
      arm: embodiment of the joints.
      capsules: from `fit_capsules`, of the same arm. They contain its shapes, so that a small negative clearance need
        not be a contact of the shapes.
      qpos: joint angles [rad].
      floor_height: see `WorldConfig`.
    """
    clearance = jax.jit(jax.vmap(make_clearance(arm, capsules, floor_height)))
    return np.stack([np.asarray(clearance(jnp.asarray(motion, jnp.float32))).min() for motion in qpos])


def touching_line(clearances: Float[np.ndarray, " motions"], noun: str = "demonstrations") -> str:
    """What `smallest_clearances` tell, as a sentence."""
    touching, smallest = np.flatnonzero(clearances < 0), f"{1e3 * clearances.min():.0f} mm"
    if not len(touching):
        return f"links touch neither each other nor the floor; smallest clearance: {smallest}"
    shown = ", ".join(map(str, touching[:_SHOWN])) + (", ..." if len(touching) > _SHOWN else "")
    return (
        f"warning: links touch each other or the floor in {len(touching)} of {len(clearances)} {noun}: {shown}; "
        f"smallest clearance: {smallest}"
    )


_SHOWN = 8  # numbers of motions
