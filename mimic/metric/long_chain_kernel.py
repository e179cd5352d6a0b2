"""The static distance of long arms and its gradient: `mimic.metric.analytic_gradient` as a loop.

The compile time of an unrolled function grows faster than the number of links. Here a loop walks along both arms
together: in each step each arm crosses a joint or stays, then one pair of links is compared. If the corresponding links
lie in order along both arms, the walk reaches every pair. For the gradient it goes from the bases to the last pair and
back, and accumulates the gradients of the distal links on the way back; the frames are then the same but for rounding.
No link is stored: the state of a sample stays in the registers of its thread.
"""

import dataclasses
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from mimic.arms.embodiment import Embodiment
from mimic.base import fused_kernel, spatial
from mimic.base.spatial import ZERO, Scalar, Vector, plus, subtract
from mimic.metric.analytic_gradient import NO_ADJOINTS, Adjoints, by_joint, compare_part, with_link
from mimic.metric.kinematics import BASE, JointFrame, LinkVectors, child_frame, link_state

_VECTORS = 4  # of an arm in a row of numbers: the last two of the link
_PER_ARM = 3 * _VECTORS


class Crossing(NamedTuple):
    """A joint that one arm crosses; vectors in the zero pose."""

    offset: Vector  # from the previous anchor to its anchor
    axis: Vector
    angle: Scalar
    speed: Scalar


class Step(NamedTuple):
    """Joints to cross, then a pair of links to compare."""

    crosses: Sequence[Scalar]  # whether each arm crosses a joint
    crossings: Sequence[Crossing]
    links: Sequence[tuple[Vector, Vector]]  # offset from the anchor, and direction
    factors: Sequence[Scalar]  # of the parts of the links' distance


class State(NamedTuple):
    """State of the walk."""

    value: Scalar  # distance of the pairs compared so far
    frames: tuple[JointFrame, ...]  # of both arms
    distal: tuple[Adjoints | None, ...]  # of both arms; None for an arm without gradient


@dataclasses.dataclass(frozen=True)
class Schedule:
    """Steps of the walk from the bases to the last pair of links.

    Attributes:
      joints: joint of each arm that is crossed in each step; -1 for none.
      numbers: of each step: the vectors of the crossing and of the link of each arm, then the factors.
      parts: indices of the parts of the distance, one for each factor.
    """

    joints: Int[np.ndarray, "steps 2"]
    numbers: Float[np.ndarray, "steps columns"]
    parts: tuple[int, ...]

    def step(self, joints: Sequence[Scalar], numbers: Sequence[Scalar], motion: Sequence[Scalar]) -> Step:
        """The step of a row of the tables.

        Args:
          joints: row of `joints`.
          numbers: row of `numbers`.
          motion: angle and speed of the expert's joint, then of the learner's.
        """
        vectors = [(numbers[k], numbers[k + 1], numbers[k + 2]) for k in range(0, 2 * _PER_ARM, 3)]
        sides = vectors[:_VECTORS], vectors[_VECTORS:]
        return Step(
            crosses=[joint >= 0 for joint in joints],
            crossings=[Crossing(*side[:2], *motion[2 * k : 2 * k + 2]) for k, side in enumerate(sides)],
            links=[(side[2], side[3]) for side in sides],
            factors=numbers[2 * _PER_ARM :],
        )


def plan(arms: Sequence[Embodiment], factors: Float[np.ndarray, "parts expert learner"]) -> Schedule | None:
    """The walk that reaches all pairs of links with a nonzero factor, and ends at the last of them.

    None where the pairs do not lie in order, where no joint moves the links of one arm, and where one is a tree.

    Args:
      arms: expert and learner, each in units of its chain length.
      factors: see `analytic_gradient.distance_and_gradient`.
    """
    if not all(arm.is_serial for arm in arms):
        return None

    def movers(pair: Sequence[int]) -> list[int]:
        return [arm.link_joint[link] for arm, link in zip(arms, pair, strict=True)]

    pairs = sorted(np.argwhere(factors.any(axis=0)).tolist(), key=movers)
    ends = [movers(pair) for pair in pairs]
    if not pairs or min(ends[-1]) < 0 or np.any(np.diff(ends, axis=0) < 0):
        return None
    parts = np.flatnonzero(factors.any(axis=(1, 2)))
    joints: list[list[int]] = []
    numbers: list[np.ndarray] = []
    current = [-1, -1]
    for pair, end in zip(pairs, ends, strict=True):
        steps = max(1, *(now - last for now, last in zip(end, current, strict=True)))
        for left in reversed(range(steps)):  # the arm with fewer joints to cross first stays
            crossed = [now - left if now - left > last else -1 for now, last in zip(end, current, strict=True)]
            links = [None, None] if left else pair
            vectors = [_vectors(arm, joint, link) for arm, joint, link in zip(arms, crossed, links, strict=True)]
            joints.append(crossed)
            numbers.append(np.concatenate([*vectors, np.zeros(len(parts)) if left else factors[parts, *pair]]))
        current = end
    return Schedule(np.array(joints, np.int32), np.array(numbers), tuple(parts.tolist()))


def _vectors(arm: Embodiment, joint: int, link: int | None) -> np.ndarray:
    """The vectors of a step for one arm; zeros for no joint and for no link."""
    anchors = np.concatenate([np.zeros((1, 3)), arm.joint_anchor])  # the base's first
    vectors = np.zeros((_VECTORS, 3))
    if joint >= 0:
        vectors[:2] = anchors[joint + 1] - anchors[joint], arm.joint_axis[joint]
    if link is not None:
        vectors[2:] = arm.link_position[link] - anchors[arm.link_joint[link] + 1], arm.link_rotation[link][:, 0]
    return vectors.ravel()


def gpu_kernel(schedule: Schedule, arguments: Sequence[int]) -> Callable[..., tuple[Array, ...]]:
    """A Pallas kernel of qpos [rad] and qvel [rad/s], each [samples, joints], of the expert, then of the learner.

    It returns the distance, [samples, 1], and its gradients with respect to some of its arguments.

    Args:
      schedule: see `plan`.
      arguments: indices of these arguments.
    """
    # Longer than 40 lines: the loops share the references that Pallas passes to the body.
    steps, num_crossed = len(schedule.joints), schedule.joints.max(axis=0) + 1
    has_gradient = [any(index // 2 == side for index in arguments) for side in (0, 1)]
    start = State(0.0, (BASE, BASE), tuple(NO_ADJOINTS if has else None for has in has_gradient))

    def body(
        inputs: Sequence[fused_kernel.Columns], outputs: Sequence[fused_kernel.Columns], joints: Any, numbers: Any
    ) -> None:
        def step(index: Array) -> Step:
            crossed, row = (
                [table[index, jnp.asarray(k)] for k in range(table.shape[1])] for table in (joints, numbers)
            )
            motion = [columns.read(crossed[k // 2]) for k, columns in enumerate(inputs)]
            return schedule.step(crossed, row, motion)

        def forward(index: Array, state: State) -> State:
            return _forward(state, step(index))

        def compare(index: Array, state: State) -> State:
            this_step = step(index)
            return _compare(schedule.parts, _forward(state, this_step), this_step)

        def backward(index: Array, state: State) -> State:
            index = steps - 1 - index
            state, gradients = _backward(schedule.parts, state, step(index))
            for columns, k in zip(outputs[1:], arguments, strict=True):
                columns.write(joints[index, k // 2], gradients[k // 2][k % 2])
            return state

        state = jax.tree.map(lambda x: jnp.full(inputs[0].mask.shape, x, inputs[0].ref.dtype), start)
        for loop in (forward, backward) if arguments else (compare,):
            state = jax.lax.fori_loop(0, steps, loop, state)
        outputs[0].write(jnp.asarray(0), state.value)

    widths = [1, *(int(num_crossed[index // 2]) for index in arguments)]
    # The fastest for 32 and 64 links, by measurement.
    launch = fused_kernel.LaunchConfig(sample_axis=1 if arguments else 0)
    kernel = fused_kernel.by_columns(body, widths, schedule.joints, schedule.numbers, launch=launch)

    def with_distal_joints(*motion: Array) -> tuple[Array, ...]:
        value, *gradients = kernel(*motion)
        sizes = [motion[index].shape[1] for index in arguments]
        return value, *(jnp.pad(x, ((0, 0), (0, n - x.shape[1]))) for x, n in zip(gradients, sizes, strict=True))

    return with_distal_joints


def _forward(state: State, step: Step) -> State:
    """Moves each arm across its joint."""

    def cross(frame: JointFrame, crossing: Crossing) -> JointFrame:
        return child_frame(frame, *crossing)

    def stay(frame: JointFrame, _: Crossing) -> JointFrame:
        return frame

    moves = zip(step.crosses, state.frames, step.crossings, strict=True)
    return state._replace(frames=tuple(jax.lax.cond(crosses, cross, stay, *move) for crosses, *move in moves))


def _compare(parts: Sequence[int], state: State, step: Step) -> State:
    """Adds the distance of the step's links."""
    links = _links(state, step)
    terms = [compare_part(part, factor, *links)[0] for part, factor in zip(parts, step.factors, strict=True)]
    return state._replace(value=sum(terms, state.value))


def _backward(parts: Sequence[int], state: State, step: Step) -> tuple[State, tuple[Any, ...]]:
    """Compares the step's links, then moves each arm back across its joint.

    Also returns the derivatives with respect to the angle and speed of that joint.
    """
    links = _links(state, step)
    value, by_learner = state.value, [ZERO] * len(LinkVectors._fields)
    for part, factor in zip(parts, step.factors, strict=True):
        term, by_learner[part] = compare_part(part, factor, *links)
        value = plus(value, term)
    by_links = [subtract(ZERO, gradient) for gradient in by_learner], by_learner
    distal = tuple(
        adjoints if adjoints is None else with_link(adjoints, link, LinkVectors(*gradients))
        for adjoints, link, gradients in zip(state.distal, links, by_links, strict=True)
    )
    moves = zip(step.crosses, state.frames, step.crossings, distal, strict=True)
    frames, by_joints = zip(
        *(jax.lax.cond(crosses, _cross_back, _stay, *move) for crosses, *move in moves), strict=True
    )
    return State(value, frames, distal), by_joints


def _links(state: State, step: Step) -> list[LinkVectors]:
    return [link_state(frame, *link) for frame, link in zip(state.frames, step.links, strict=True)]


def _cross_back(frame: JointFrame, crossing: Crossing, distal: Adjoints | None) -> tuple[JointFrame, Any]:
    """The frame of the joint's parent body; the derivatives with respect to its angle and speed, or None."""
    offset, axis, angle, speed = crossing
    axis_now = spatial.rotate(frame.rotation, axis)
    rotation = spatial.compose(frame.rotation, spatial.transpose(spatial.axis_rotation(axis, angle)))
    offset = spatial.rotate(rotation, offset)
    angular_velocity = subtract(frame.angular_velocity, spatial.scale(speed, axis_now))
    parent = JointFrame(
        rotation=rotation,
        anchor=subtract(frame.anchor, offset),
        angular_velocity=angular_velocity,
        linear_velocity=subtract(frame.linear_velocity, spatial.cross(angular_velocity, offset)),
    )
    return parent, None if distal is None else by_joint(frame, axis_now, distal)


def _stay(frame: JointFrame, _: Crossing, distal: Adjoints | None) -> tuple[JointFrame, Any]:
    zero = jnp.zeros_like(frame.anchor[0])
    return frame, None if distal is None else (zero, zero)
