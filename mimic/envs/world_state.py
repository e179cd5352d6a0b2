"""The state of an episode with an inner loop."""

from flax import struct
from jaxtyping import Array, Float

from mimic.control.joint_control import Reference
from mimic.envs.arm_state import ArmState
from mimic.physics.plant import Draw


@struct.dataclass(kw_only=True)
class HardwareState(ArmState):
    """The state of an episode with an inner loop. Rows of a history are ticks, the newest first.

    Attributes:
      reference: the motion that the inner loop tracks, [joints] each.
      torque: [joints] torque of the last period [N m].
      sent: [ticks, numbers] the policy's last actions, which it observes.
      arrived: [ticks, numbers] the last actions that arrived at the robot.
      target: [joints] that acts at the end of the last tick.
      measured: [ticks, 4 * joints] measured angles and velocities, and angles and velocities of the reference.
      draw: what was drawn for the episode.
    """

    reference: Reference
    torque: Float[Array, " joints"]
    sent: Float[Array, "ticks numbers"]
    arrived: Float[Array, "ticks numbers"]
    target: Float[Array, " joints"]
    measured: Float[Array, "ticks numbers"]
    draw: Draw
