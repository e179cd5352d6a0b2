"""The clearance of an arm as a function of its pose, see `mimic.control.clearance`."""

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from mimic.arms.capsules import Capsules
from mimic.arms.embodiment import Embodiment
from mimic.control import clearance as control_clearance
from mimic.control.clearance import ClearanceConstants
from mimic.metric.capsule_distances import colliding_pairs


def make_clearance(
    arm: Embodiment, capsules: Capsules, floor_height: float = 0.0
) -> Callable[[Float[Array, " joints"]], Float[Array, ""]]:
    """Makes the function from joint angles [rad] to the clearance [m] of an arm, see `clearance_constants`."""
    constants = clearance_constants(arm, capsules, floor_height)

    def clearance(qpos: Float[Array, " joints"]) -> Float[Array, ""]:
        with jax.default_matmul_precision("highest"):  # TF32 would cost a millimetre
            return control_clearance.clearance(qpos, constants, jnp)

    return clearance


def clearance_constants(arm: Embodiment, capsules: Capsules, floor_height: float = 0.0) -> ClearanceConstants:
    """The constants of an arm's clearance.

    It is the minimum distance of the capsules' pairs that joints change, and of the capsules from the floor, except
    those on the base and on the joints at the base.

    Args:
      arm: the embodiment.
      capsules: from `fit_capsules`, of the same arm.
      floor_height: height of the floor in the base frame [m].
    """
    lengths = arm.joint_axis, arm.joint_anchor, capsules.start, capsules.end, capsules.radius, floor_height
    axis, anchor, start, end, radius, floor = (np.asarray(x, np.float32) for x in lengths)
    return ClearanceConstants(
        parent=np.array(arm.joint_parent),
        axis=axis,
        anchor=anchor,
        joint=np.array(capsules.joint),
        start=start,
        end=end,
        radius=radius,
        pairs=np.array(colliding_pairs(arm, capsules), int).reshape(-1, 2),
        above=np.flatnonzero(~np.array(capsules.near_base)),
        floor_height=floor,
    )
