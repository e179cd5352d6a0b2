"""The state of an episode, which a brax state carries."""

import mimic.base.quiet_mjx  # noqa: F401  # before brax

# isort: split
from typing import cast

from brax.envs.base import State
from flax import struct
from jaxtyping import Array, Float, Int


@struct.dataclass
class ArmState:
    """The state of an episode.

    Attributes:
      qpos: learner's joint angles [rad].
      qvel: learner's joint velocities [rad/s].
      step: control steps since the start of the demonstration.
      demonstration: index of the demonstration.
      key: random key for the noise of this episode and for the following episodes.
    """

    qpos: Float[Array, " joints"]
    qvel: Float[Array, " joints"]
    step: Int[Array, ""]
    demonstration: Int[Array, ""]
    key: Array


def arm_state(state: State) -> ArmState:
    """The `ArmState` in a brax state, with its type."""
    return cast(ArmState, state.pipeline_state)
