"""Simulation of the inner loop: reference, torque and motion of an arm at 1 kHz, for the duration of a control step.

The controller is that of `mimic.control`. The arm is simulated by the dynamics of any arm, whose numbers are arguments:
masses and payload differ in each episode. A step is that of MuJoCo's Euler integrator: semi-implicit, with the damping
of the joints implicit. Payload, friction and gravity are those of the episode.
"""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from mimic.base import fused_kernel
from mimic.control import joint_control
from mimic.control.joint_control import PERIOD, JointParameters, Reference
from mimic.physics import composite_kernel, looped_dynamics
from mimic.physics.composite_kernel import read_joints, read_rows, write_rows
from mimic.physics.dynamics import acceleration, with_locks
from mimic.physics.joint_numbers import NUMBERS
from mimic.physics.trigonometry import cosine_and_sine


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


InnerLoop = Callable[[Episode, LoopState, Array], LoopState]


def make_inner_loop(mode: str, constants: JointConstants, periods: int) -> InnerLoop:
    """Makes a function (episode, state, [joints] target) -> state after `periods` ms.

    It takes one sample, and is a single kernel on NVIDIA GPUs if it is batched by `jax.vmap`.

    Args:
      mode: one of `joint_control.MODES`.
      constants: of the joints.
      periods: duration [ms].
    """
    plain = jax.jit(array_loop(mode, constants, periods))
    kernel = gpu_kernel(mode, constants, periods)
    function = fused_kernel.batched_by(kernel, plain, fused_kernel.with_batch_last(plain))

    def inner_loop(episode: Episode, state: LoopState, target: Array) -> LoopState:
        (after,) = function(*flattened(episode, state, target))
        return _state_of(after.reshape(-1, _ROWS).T)

    return inner_loop


def flattened(episode: Episode, state: LoopState, target: Array) -> tuple[Array, ...]:
    """The arguments of a sample as vectors, with the numbers of each joint together, as `gpu_kernel` takes them."""
    drive = episode.gain, episode.friction, episode.bias
    motion = state.qpos, state.qvel, *state.reference, state.torque
    by_joint = (jnp.stack(arrays, axis=1).ravel() for arrays in (drive, motion))
    return episode.numbers, episode.base, *by_joint, target


def _state_of(rows: Any) -> LoopState:
    qpos, qvel, *reference, torque = rows
    return LoopState(qpos, qvel, Reference(*reference), torque)


_ROWS = 6  # of a `LoopState`


def control(
    mode: str,
    constants: JointConstants,
    state: LoopState,
    target: Any,
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
        reference = joint_control.next_reference(mode, reference, target, joint_control.reference_limits(joints), jnp)
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


def array_loop(mode: str, constants: JointConstants, periods: int) -> Callable[..., tuple[Array]]:
    """The loop on arrays [size, *batch], for CPUs and for derivatives."""
    joints = len(constants.minimum)

    def loop(numbers: Array, base: Array, drive: Array, motion: Array, target: Array) -> tuple[Array]:
        batch = numbers.shape[1:]
        by_joint = numbers.reshape(-1, NUMBERS, *batch)
        by_row = (jnp.moveaxis(x.reshape(joints, -1, *batch), 1, 0) for x in (drive, motion))
        drives, motions = map(list, by_row)
        parameters = jax.tree.map(lambda x: jnp.asarray(x, motion.dtype).reshape(joints, *[1] * len(batch)), constants)

        def period(_: Any, state: LoopState) -> LoopState:
            reference, torque, acting = control(mode, parameters, state, target, drives)
            qacc = looped_dynamics.acceleration(by_joint, state.qpos, state.qvel, acting, tuple(base))
            qvel = state.qvel + PERIOD * qacc
            return LoopState(state.qpos + PERIOD * qvel, qvel, reference, torque)

        after = jax.lax.fori_loop(0, periods, period, _state_of(motions))
        rows = jnp.stack([after.qpos, after.qvel, *after.reference, after.torque], axis=1)
        return (rows.reshape(motion.shape),)

    return loop


def gpu_kernel(
    mode: str,
    constants: JointConstants,
    periods: int,
    launch: fused_kernel.LaunchConfig = composite_kernel.LAUNCH,
) -> Callable[..., tuple[Array, ...]]:
    """The loop as a Pallas kernel on arrays [samples, width]: (numbers, base, drive, motion, target) -> (motion,).

    See `flattened`. As in mimic/physics/composite_kernel.py only loading and storing are loops over the joints. What is
    the same in all episodes is part of the code, and what is constant in an episode is loaded once.
    """
    count = len(constants.minimum)
    by_joint = [jax.tree.map(lambda x, joint=joint: float(x[joint]), constants) for joint in range(count)]

    def body(inputs: Sequence[fused_kernel.Columns], outputs: Sequence[fused_kernel.Columns]) -> None:
        numbers, base, *of_joints = inputs
        (base_acceleration,) = read_rows(base, 1)
        joints = with_locks(read_joints(numbers, count))
        drives, motions, targets = (read_rows(columns, count) for columns in of_joints)

        def period(_: Any, states: tuple[LoopState, ...]) -> tuple[LoopState, ...]:
            controlled = []
            for joint, state, (target,), drive in zip(by_joint, states, targets, drives, strict=True):
                controlled.append(control(mode, joint, state, target, drive))
            qpos, qvel, *_ = zip(*states, strict=True)
            acting = [torque for _, _, torque in controlled]
            qacc = acceleration(joints, qpos, qvel, acting, base_acceleration, cosine_and_sine)
            after = []
            for state, (reference, torque, _), a in zip(states, controlled, qacc, strict=True):
                speed = state.qvel + PERIOD * a
                after.append(LoopState(state.qpos + PERIOD * speed, speed, reference, torque))
            return tuple(after)

        states = jax.lax.fori_loop(0, periods, period, tuple(_state_of(row) for row in motions))
        write_rows(outputs[0], [jax.tree.leaves(state) for state in states])

    return fused_kernel.by_columns(body, (_ROWS * count,), launch=launch)
