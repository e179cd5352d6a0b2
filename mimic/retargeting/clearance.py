"""The clearance of an arm as a function of its pose, see `mimic.control.clearance`."""

from collections.abc import Callable

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from mimic.arms.capsules import Capsules
from mimic.arms.embodiment import Embodiment
from mimic.control import clearance as control_clearance
from mimic.metric.capsule_distances import clearance_constants


def make_clearance(
    arm: Embodiment, capsules: Capsules, floor_height: float = 0.0
) -> Callable[[Float[Array, " joints"]], Float[Array, ""]]:
    """Makes the function from joint angles [rad] to the clearance [m] of an arm, see `clearance_constants`."""
    constants = clearance_constants(arm, capsules, floor_height)

    def clearance(qpos: Float[Array, " joints"]) -> Float[Array, ""]:
        with jax.default_matmul_precision("highest"):  # TF32 would cost a millimetre
            return control_clearance.clearance(qpos, constants, jnp)

    return clearance
