"""Simulation of the inner loop: reference, torque and motion of an arm at 1 kHz, for the duration of a control step.

The controller is that of `mimic.control`. The arm is simulated by the dynamics of any arm, whose numbers are arguments:
masses and payload differ in each episode. A step is that of MuJoCo's Euler integrator: semi-implicit, with the damping
of the joints implicit. Payload, friction and gravity are those of the episode.
"""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from mimic.any_arm import articulated_kernel, dynamics, looped_dynamics
from mimic.any_arm.arrays import MAX_JOINTS
from mimic.control import joint_control
from mimic.control.joint_control import PERIOD, JointParameters, Reference, Target
from mimic.metric import fused_kernel

_NO_LOAD = (1.0, 1.0)  # factors of `articulated_kernel.acceleration`: the numbers have the masses of the episode


class JointConstants(NamedTuple):
    """What the inner loop needs to know of each joint, and what is the same in all episodes: [joints] each.

    Attributes:
      parameters: of the controller.
      friction_rate: see `JointFriction`.
      minimum, maximum: angles of the mechanical stops [rad]; infinite where there are none.
      stop_stiffness, stop_damping: of the stops [N m/rad, N m s/rad].
    """

    parameters: JointParameters
    friction_rate: Any
    minimum: Any
    maximum: Any
    stop_stiffness: Any
    stop_damping: Any


class Episode(NamedTuple):
    """The arm of an episode, as the inner loop needs it.

    Attributes:
      numbers: [numbers] `joint_numbers` of the arm with its payload; the armature includes period * damping.
      base: [3] minus the gravity that is not compensated, in the frame of the first joint at angle 0 [m/s^2].
      gain: [joints] ratio of the acting to the commanded torque.
      friction: [joints] friction torque at high speed [N m].
      bias: [joints] error of the measured angles [rad].
    """

    numbers: Float[Array, " numbers"]
    base: Float[Array, "3"]
    gain: Float[Array, " joints"]
    friction: Float[Array, " joints"]
    bias: Float[Array, " joints"]


class LoopState(NamedTuple):
    """The state of arm and controller, [joints] each.

    Attributes:
      qpos, qvel: of the arm [rad, rad/s].
      reference: what the controller tracks.
      torque: commanded in the last period [N m].
    """

    qpos: Any
    qvel: Any
    reference: Reference
    torque: Any


InnerLoop = Callable[[Episode, LoopState, Target], LoopState]


def make_inner_loop(mode: str, constants: JointConstants, periods: int) -> InnerLoop:
    """Makes a function (episode, state, target) -> state after `periods` ms.

    It takes one sample, and is a single kernel on NVIDIA GPUs if it is batched by `jax.vmap`. All vectors have a number
    for each of the 8 slots of a joint.

    Args:
      mode: one of `joint_control.MODES`.
      constants: of the joints.
      periods: duration [ms].
    """
    plain = jax.jit(_array_loop(mode, constants, periods))
    kernel = gpu_kernel(mode, constants, periods)
    function = fused_kernel.batched_by(kernel, plain, fused_kernel.with_batch_last(plain))

    def inner_loop(episode: Episode, state: LoopState, target: Target) -> LoopState:
        motion = jnp.concatenate([state.qpos, state.qvel, *state.reference, state.torque])
        drive = jnp.concatenate([episode.gain, episode.friction, episode.bias])
        (after,) = function(episode.numbers, episode.base, drive, motion, jnp.concatenate(target))
        return _state_of(jnp.split(after, len(motion) // MAX_JOINTS))

    return inner_loop


def _state_of(rows: Sequence[Any]) -> LoopState:
    qpos, qvel, *reference, torque = rows
    return LoopState(qpos, qvel, Reference(*reference), torque)


_ROWS = 6  # of a `LoopState`


def control(
    mode: str,
    constants: JointConstants,
    state: LoopState,
    target: Target,
    drive: Sequence[Any],
) -> tuple[Reference, Any, Any]:
    """One period of the controller: the reference, the commanded torque and the torque that acts on the arm [N m].

    Args:
      mode: one of `joint_control.MODES`.
      constants: of the joints.
      state: of arm and controller.
      target: of the policy.
      drive: gain, friction and bias, see `Episode`.
    """
    gain, friction, bias = drive
    reference, joints = state.reference, constants.parameters
    if mode != "torque":
        reference = joint_control.next_reference(
            mode, reference, target.value, joint_control.reference_limits(joints), jnp
        )
    torque = joint_control.joint_torque(
        mode, state.qpos + bias, state.qvel, reference, target, state.torque, joints, jnp
    )
    acting = gain * torque - joint_control.friction_torque(state.qvel, friction, constants.friction_rate, jnp)
    return reference, torque, acting + stop_torque(state.qpos, state.qvel, constants)


def stop_torque(qpos: Any, qvel: Any, constants: JointConstants) -> Any:
    """Torque of the mechanical stops [N m]: stiff springs with dampers beyond the joint range."""
    beyond = jnp.maximum(qpos - constants.maximum, 0.0) - jnp.maximum(constants.minimum - qpos, 0.0)
    damping = jnp.where(beyond == 0.0, 0.0, constants.stop_damping)
    return -constants.stop_stiffness * beyond - damping * qvel


def _array_loop(mode: str, constants: JointConstants, periods: int) -> Callable[..., tuple[Array]]:
    """The loop on arrays [size, *batch], for CPUs and for derivatives."""

    def loop(numbers: Array, base: Array, drive: Array, motion: Array, target: Array) -> tuple[Array]:
        batch = numbers.shape[1:]
        by_joint = numbers.reshape(MAX_JOINTS, dynamics.NUMBERS, *batch)
        drives, targets = (list(x.reshape(-1, MAX_JOINTS, *batch)) for x in (drive, target))
        by_row = jax.tree.map(lambda x: jnp.asarray(x, motion.dtype).reshape(MAX_JOINTS, *[1] * len(batch)), constants)
        one = jnp.ones((), motion.dtype)

        def period(_: Any, state: LoopState) -> LoopState:
            reference, torque, acting = control(mode, by_row, state, Target(*targets), drives)
            qacc = looped_dynamics.acceleration(by_joint, state.qpos, state.qvel, acting, one, one, tuple(base))
            qvel = state.qvel + PERIOD * qacc
            return LoopState(state.qpos + PERIOD * qvel, qvel, reference, torque)

        state = _state_of(list(motion.reshape(_ROWS, MAX_JOINTS, *batch)))
        after = jax.lax.fori_loop(0, periods, period, state)
        return (jnp.concatenate([after.qpos, after.qvel, *after.reference, after.torque]),)

    return loop


def gpu_kernel(
    mode: str,
    constants: JointConstants,
    periods: int,
    launch: fused_kernel.LaunchConfig = articulated_kernel.LAUNCH,
) -> Callable[..., tuple[Array, ...]]:
    """The loop as a Pallas kernel on arrays [samples, width], with loops over the joints."""
    leaves, structure = jax.tree.flatten(constants)
    table = np.stack([np.asarray(leaf, float) for leaf in leaves], axis=1).ravel()  # the numbers of a joint together

    def body(inputs: Sequence[Any], outputs: Sequence[Any], bound_ref: Any, table_ref: Any) -> None:
        numbers, base, drive, motion, target = inputs
        loop = articulated_kernel.rotating_rows(bound_ref[jnp.asarray(0)], 1)
        base_acceleration = tuple(base.read(jnp.asarray(k)) for k in range(3))

        def joint_at(index: Array) -> dynamics.JointNumbers:
            return dynamics.joint_of([numbers.read(dynamics.NUMBERS * index + k) for k in range(dynamics.NUMBERS)])

        def controlled(index: Array, carry: Any, row: tuple[Any, ...]) -> Any:
            of_joint = jax.tree.unflatten(structure, [table_ref[len(leaves) * index + k] for k in range(len(leaves))])
            drives = [drive.read(MAX_JOINTS * k + index) for k in range(3)]
            targets = Target(target.read(index), target.read(MAX_JOINTS + index))
            state = _state_of(row[:_ROWS])
            reference, torque, acting = control(mode, of_joint, state, targets, drives)
            return carry, (state.qpos, state.qvel, *reference, torque, acting)

        def period(_: Any, rows: Any) -> Any:
            _, rows = loop(controlled, jnp.zeros_like(rows[0][0]), rows, extra=1)
            qpos, qvel, acting = (tuple(row[k] for row in rows) for k in (0, 1, _ROWS))
            qacc = articulated_kernel.acceleration(joint_at, loop, qpos, qvel, acting, _NO_LOAD, base_acceleration)
            return tuple(_moved(row, a) for row, a in zip(rows, qacc, strict=True))

        rows = tuple(
            tuple(motion.read(jnp.asarray(MAX_JOINTS * k + joint)) for k in range(_ROWS)) for joint in range(MAX_JOINTS)
        )
        for joint, row in enumerate(jax.lax.fori_loop(0, periods, period, rows)):
            for k, value in enumerate(row):
                outputs[0].write(jnp.asarray(MAX_JOINTS * k + joint), value)

    # A bound that is loaded keeps the compiler from unrolling the loops over the joints.
    bound = np.full(1, MAX_JOINTS, np.int32)
    return fused_kernel.by_columns(body, (_ROWS * MAX_JOINTS,), bound, table, launch=launch)


def _moved(row: tuple[Any, ...], qacc: Any) -> tuple[Any, ...]:
    """The rows of a joint after the step of the arm, without the acting torque."""
    qpos, qvel, *others = row[:_ROWS]
    qvel = qvel + PERIOD * qacc
    return (qpos + PERIOD * qvel, qvel, *others)


def padded(constants: JointConstants) -> JointConstants:
    """The constants with harmless numbers in the empty slots: 1, and -1 for minima."""

    def fill(values: Any, empty: float = 1.0) -> np.ndarray:
        values = np.asarray(values, float)
        return np.concatenate([values, np.full(MAX_JOINTS - len(values), empty)])

    filled = jax.tree.map(fill, constants)
    parameters = filled.parameters._replace(lower=fill(constants.parameters.lower, -1.0))
    return filled._replace(parameters=parameters, minimum=fill(constants.minimum, -1.0))
