"""The usual embodiment distance of long arms and its gradient: `mimic.metric.analytic_gradient` as a loop.

A program that spells out all links takes a time to compile that grows faster than their number. Here both arms are
walked along at once, a step at a time: each arm crosses a joint or stays, then a pair of links is compared. Where the
links that correspond lie in order along both arms, every pair is met so. For the gradient the arms are first walked to
the last pair, then back, and the slopes of the links behind are gathered on the way; a frame is then what it was but
for rounding. Nothing is kept of a link once it is passed: what a sample takes stays in the registers of its thread.
"""

import dataclasses
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from mimic.arms.embodiment import Embodiment
from mimic.metric import fused_kernel, spatial
from mimic.metric.analytic_gradient import NO_ADJOINTS, Adjoints, by_joint, compare_part, with_link
from mimic.metric.kinematics import BASE, JointFrame, LinkVectors, child_frame, link_state
from mimic.metric.spatial import ZERO, Scalar, Vector, plus, subtract

_VECTORS = 4  # of an arm in a row of numbers: the last two of the link
_PER_ARM = 3 * _VECTORS


class Crossing(NamedTuple):
    """Of a joint by one arm; vectors are those of the zero pose."""

    offset: Vector  # of its anchor, from the one before
    axis: Vector
    angle: Scalar
    speed: Scalar


class Step(NamedTuple):
    """Joints that are crossed, then links that are compared."""

    crosses: Sequence[Scalar]  # whether each arm does
    crossings: Sequence[Crossing]
    links: Sequence[tuple[Vector, Vector]]  # lever from the anchor, and direction
    factors: Sequence[Scalar]  # what the parts of the links' distance count for


class State(NamedTuple):
    """Of a walk."""

    value: Scalar  # of the pairs that were compared
    frames: tuple[JointFrame, ...]  # of both arms
    behind: tuple[Adjoints | None, ...]  # of both; None where no gradient is wanted


@dataclasses.dataclass(frozen=True)
class Schedule:
    """From the bases to the last pair of links.

    Attributes:
      joints: that are crossed in each step; -1 where none.
      numbers: of each step: vectors of the crossing and of the link of each arm, then factors.
      parts: indices of the parts of the distance that the factors are of.
    """

    joints: Int[np.ndarray, "steps 2"]
    numbers: Float[np.ndarray, "steps columns"]
    parts: tuple[int, ...]

    def step(self, joints: Sequence[Scalar], numbers: Sequence[Scalar], motion: Sequence[Scalar]) -> Step:
        """Of a row of the tables, with angle and speed of each arm's joint."""
        vectors = [(numbers[k], numbers[k + 1], numbers[k + 2]) for k in range(0, 2 * _PER_ARM, 3)]
        sides = vectors[:_VECTORS], vectors[_VECTORS:]
        return Step(
            crosses=[joint >= 0 for joint in joints],
            crossings=[Crossing(*side[:2], *motion[2 * k : 2 * k + 2]) for k, side in enumerate(sides)],
            links=[(side[2], side[3]) for side in sides],
            factors=numbers[2 * _PER_ARM :],
        )


def plan(arms: Sequence[Embodiment], factors: Float[np.ndarray, "parts expert learner"]) -> Schedule | None:
    """The walk that meets all pairs of links whose factors are not 0; what lies beyond the last of them is left out.

    None where the pairs do not lie in order, or where none of the links of an arm has a joint before it.

    Args:
      arms: expert and learner, each in units of its chain length.
      factors: see `motion_gradient.distance_and_gradient`.
    """

    def movers(pair: Sequence[int]) -> list[int]:
        return [arm.link_joint[link] for arm, link in zip(arms, pair, strict=True)]

    pairs = sorted(np.argwhere(factors.any(axis=0)).tolist(), key=movers)
    ends = [movers(pair) for pair in pairs]
    if not pairs or min(ends[-1]) < 0 or np.any(np.diff(ends, axis=0) < 0):
        return None
    parts = np.flatnonzero(factors.any(axis=(1, 2)))
    joints: list[list[int]] = []
    numbers: list[np.ndarray] = []
    reached = [-1, -1]
    for pair, end in zip(pairs, ends, strict=True):
        steps = max(1, *(now - last for now, last in zip(end, reached, strict=True)))
        for left in reversed(range(steps)):  # the arm with fewer joints to cross stays first
            crossed = [now - left if now - left > last else -1 for now, last in zip(end, reached, strict=True)]
            links = [None, None] if left else pair
            vectors = [_vectors(arm, joint, link) for arm, joint, link in zip(arms, crossed, links, strict=True)]
            joints.append(crossed)
            numbers.append(np.concatenate([*vectors, np.zeros(len(parts)) if left else factors[parts, *pair]]))
        reached = end
    return Schedule(np.array(joints, np.int32), np.array(numbers), tuple(parts.tolist()))


def _vectors(arm: Embodiment, joint: int, link: int | None) -> np.ndarray:
    """Of a step, for one arm; zeros for a joint or a link that there is not."""
    anchors = np.concatenate([np.zeros((1, 3)), arm.joint_anchor])  # the base's first
    vectors = np.zeros((_VECTORS, 3))
    if joint >= 0:
        vectors[:2] = anchors[joint + 1] - anchors[joint], arm.joint_axis[joint]
    if link is not None:
        vectors[2:] = arm.link_position[link] - anchors[arm.link_joint[link] + 1], arm.link_rotation[link][:, 0]
    return vectors.ravel()


def gpu_kernel(walk: Schedule, wanted: Sequence[int]) -> Callable[..., tuple[Array, ...]]:
    """A Pallas kernel of qpos [rad] and qvel [rad/s], each [samples, joints], of the expert, then of the learner.

    It gives the distance, [samples, 1], and its gradient by those of its arguments that are wanted.

    Args:
      walk: see `plan`.
      wanted: indices of arguments.
    """
    steps, reached = len(walk.joints), walk.joints.max(axis=0) + 1
    has_gradient = [any(index // 2 == side for index in wanted) for side in (0, 1)]
    start = State(0.0, (BASE, BASE), tuple(NO_ADJOINTS if has else None for has in has_gradient))

    def body(
        given: Sequence[fused_kernel.Columns], made: Sequence[fused_kernel.Columns], joints: Any, numbers: Any
    ) -> None:
        def step(index: Array) -> Step:
            crossed, row = (
                [table[index, jnp.asarray(k)] for k in range(table.shape[1])] for table in (joints, numbers)
            )
            motion = [columns.read(crossed[k // 2]) for k, columns in enumerate(given)]
            return walk.step(crossed, row, motion)

        def onward(index: Array, state: State) -> State:
            return _onward(state, step(index))

        def compare(index: Array, state: State) -> State:
            there = step(index)
            return _compare(walk.parts, _onward(state, there), there)

        def back(index: Array, state: State) -> State:
            index = steps - 1 - index
            state, slopes = _back(walk.parts, state, step(index))
            for columns, k in zip(made[1:], wanted, strict=True):
                columns.write(joints[index, k // 2], slopes[k // 2][k % 2])
            return state

        state = jax.tree.map(lambda x: jnp.full(given[0].inside.shape, x, given[0].ref.dtype), start)
        for loop in (onward, back) if wanted else (compare,):
            state = jax.lax.fori_loop(0, steps, loop, state)
        made[0].write(jnp.asarray(0), state.value)

    widths = [1, *(int(reached[index // 2]) for index in wanted)]
    layout = fused_kernel.LaunchConfig(
        sample_axis=1 if wanted else 0
    )  # the fastest for 32 and 64 links, by measurement
    walked = fused_kernel.by_columns(body, widths, walk.joints, walk.numbers, layout=layout)

    def with_joints_beyond(*motion: Array) -> tuple[Array, ...]:
        value, *gradients = walked(*motion)
        sizes = [motion[index].shape[1] for index in wanted]
        return value, *(jnp.pad(x, ((0, 0), (0, n - x.shape[1]))) for x, n in zip(gradients, sizes, strict=True))

    return with_joints_beyond


def _onward(state: State, step: Step) -> State:
    """Each arm across its joint."""

    def cross(frame: JointFrame, crossing: Crossing) -> JointFrame:
        return child_frame(frame, *crossing)

    def stay(frame: JointFrame, _: Crossing) -> JointFrame:
        return frame

    moves = zip(step.crosses, state.frames, step.crossings, strict=True)
    return state._replace(frames=tuple(jax.lax.cond(crosses, cross, stay, *move) for crosses, *move in moves))


def _compare(parts: Sequence[int], state: State, step: Step) -> State:
    """With the distance of the step's links."""
    links = _links(state, step)
    terms = [compare_part(part, factor, *links)[0] for part, factor in zip(parts, step.factors, strict=True)]
    return state._replace(value=sum(terms, state.value))


def _back(parts: Sequence[int], state: State, step: Step) -> tuple[State, tuple[Any, ...]]:
    """The step's links compared, then each arm back across its joint; the slopes by that joint's angle and speed."""
    links = _links(state, step)
    value, by_learner = state.value, [ZERO] * len(LinkVectors._fields)
    for part, factor in zip(parts, step.factors, strict=True):
        term, by_learner[part] = compare_part(part, factor, *links)
        value = plus(value, term)
    by_links = [subtract(ZERO, slope) for slope in by_learner], by_learner
    behind = tuple(
        own if own is None else with_link(own, link, LinkVectors(*slopes))
        for own, link, slopes in zip(state.behind, links, by_links, strict=True)
    )
    moves = zip(step.crosses, state.frames, step.crossings, behind, strict=True)
    frames, by_joints = zip(
        *(jax.lax.cond(crosses, _cross_back, _stay, *move) for crosses, *move in moves), strict=True
    )
    return State(value, frames, behind), by_joints


def _links(state: State, step: Step) -> list[LinkVectors]:
    return [link_state(frame, *link) for frame, link in zip(state.frames, step.links, strict=True)]


def _cross_back(frame: JointFrame, crossing: Crossing, behind: Adjoints | None) -> tuple[JointFrame, Any]:
    """The body before the joint; the slopes by its angle and speed, where they are wanted."""
    offset, axis, angle, speed = crossing
    axis_now = spatial.rotate(frame.rotation, axis)
    rotation = spatial.compose(frame.rotation, spatial.transpose(spatial.axis_rotation(axis, angle)))
    lever = spatial.rotate(rotation, offset)
    spin = subtract(frame.angular_velocity, spatial.scale(speed, axis_now))
    before = JointFrame(
        rotation=rotation,
        anchor=subtract(frame.anchor, lever),
        angular_velocity=spin,
        linear_velocity=subtract(frame.linear_velocity, spatial.cross(spin, lever)),
    )
    return before, None if behind is None else by_joint(frame, axis_now, behind)


def _stay(frame: JointFrame, _: Crossing, behind: Adjoints | None) -> tuple[JointFrame, Any]:
    nothing = jnp.zeros_like(frame.anchor[0])
    return frame, None if behind is None else (nothing, nothing)
