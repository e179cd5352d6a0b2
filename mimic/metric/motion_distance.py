"""The embodiment distance as a function of two arms' joint motions: from angles and velocities to one number."""

import dataclasses
import functools
from collections.abc import Callable
from typing import Any, cast

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jax.custom_derivatives import SymbolicZero
from jaxtyping import Array, Float

from mimic.arms.embodiment import Embodiment
from mimic.metric import analytic_gradient, fused_kernel, long_chain_kernel
from mimic.metric.distance import (
    PAPER_WEIGHTS,
    PARTS,
    Correspondence,
    DistanceWeights,
    Metric,
    Reduction,
    RotationMeasure,
    Weights,
    pair_distances,
)
from mimic.metric.kinematics import LONG, joint_values, link_states

Values = Callable[..., tuple[Array, ...]]  # of motions: a distance, and gradients
MotionDistance = Callable[..., Float[Array, ""]]  # expert_qpos, expert_qvel, learner_qpos, learner_qvel


def motion_distance(
    expert: Embodiment,
    learner: Embodiment,
    correspondence: Correspondence,
    weights: Weights = PAPER_WEIGHTS,
    *,
    rotation: RotationMeasure = "cosine",
    reduction: Reduction = "mean",
) -> MotionDistance:
    """A function (expert_qpos, expert_qvel, learner_qpos, learner_qvel) -> embodiment distance, of one sample each.

    It equals `embodiment_distance` of both arms' `link_states`, and is made once for two arms so that all that is known
    of them costs nothing later. For the usual metric, a given matrix and constant weights with the mean of the smooth
    rotational measure, it is a program of its own: pairs of links that do not correspond and parts that weigh nothing
    are left out, the gradient is in closed form (forward or reverse, of those arguments alone that are differentiated),
    and `jax.vmap` of it, or of its gradient, is one kernel on NVIDIA GPUs. With an arm of more than 16 joints it is a
    loop over the joints, which compiles in seconds: one kernel too if the links that correspond lie in order along both
    arms; else, and on CPUs, many and slower ones, differentiated automatically. Any other metric is the plain
    composition.

    Args:
      expert: the embodiment that is imitated.
      learner: the one that imitates.
      correspondence: see `embodiment_distance`.
      weights: see `embodiment_distance`.
      rotation: see `embodiment_distance`.
      reduction: see `embodiment_distance`.

    Returns:
      The function; batch it with `jax.vmap`. It raises ValueError where an argument is not one number for each joint.

    Raises:
      ValueError: what `embodiment_distance` refuses.
    """
    arms, metric = (expert, learner), Metric(correspondence, weights, rotation, reduction)

    def composed(*motion: Array) -> Array:
        states = link_states(expert, *motion[:2]), link_states(learner, *motion[2:])
        return metric(*states)

    # Refuses what it does not know, for all of the ways below.
    jax.eval_shape(composed, *(jax.ShapeDtypeStruct((arm.num_joints,), jnp.float32) for arm in arms for _ in range(2)))
    if metric.is_static and _is_known((arms, correspondence, weights)):
        factors = _factors(np.asarray(correspondence, float), cast(DistanceWeights, weights))
        is_long = max(expert.num_joints, learner.num_joints) > LONG
        distance = (_long if is_long else _short)([_of_length_one(arm) for arm in arms], factors)
    else:
        distance = composed

    def of_motions(expert_qpos: Any, expert_qvel: Any, learner_qpos: Any, learner_qvel: Any) -> Array:
        given = {"expert_qpos": expert_qpos, "expert_qvel": expert_qvel}
        given |= {"learner_qpos": learner_qpos, "learner_qvel": learner_qvel}
        owners = expert, expert, learner, learner
        motion = [joint_values(arm, values, what) for arm, (what, values) in zip(owners, given.items(), strict=True)]
        dtype = jnp.result_type(*motion)
        return distance(*(values.astype(dtype) for values in motion))

    return of_motions


def _is_known(tree: Any) -> bool:
    return not any(isinstance(leaf, Tracer) for leaf in jax.tree.leaves(tree))


def _factors(matrix: Float[np.ndarray, "expert learner"], weights: DistanceWeights) -> np.ndarray:
    """What each part of each pair's distance counts for in the mean, [4, n, n_hat]."""
    of_parts = [np.broadcast_to(np.asarray(getattr(weights, part), float), matrix.shape) for part in PARTS]
    return np.stack(of_parts) * matrix / matrix.size


def _by_pairs(arms: list[Embodiment], factors: np.ndarray) -> Callable[..., Array]:
    """The pairs of links that correspond, and no others."""
    chosen = np.nonzero(factors.any(axis=0))
    weighing = [part for part, factor in zip(PARTS, factors, strict=True) if factor.any()] or PARTS[:1]
    factors = np.stack([factors[PARTS.index(part), *chosen] for part in weighing])

    def distance(*motion: Array) -> Array:
        states = link_states(arms[0], *motion[:2]), link_states(arms[1], *motion[2:])
        ends = [jax.tree.map(lambda x, rows=rows: x[rows], own) for own, rows in zip(states, chosen, strict=True)]
        parts = jax.vmap(functools.partial(pair_distances, measure="cosine"))(*ends)
        distances = jnp.stack([getattr(parts, part) for part in weighing])
        return jnp.sum(factors.astype(distances.dtype) * distances)

    return distance


def _short(arms: list[Embodiment], factors: np.ndarray) -> Callable[..., Array]:
    """All links spelled out."""
    joints = [arm.num_joints for arm in arms for _ in range(2)]

    def values(wanted: tuple[int, ...]) -> Values:
        program = functools.partial(analytic_gradient.distance_and_gradient, *arms, factors, wanted)
        return fused_kernel.fused(program, [1, *(joints[k] for k in wanted)])

    return _with_gradient(values)


def _long(arms: list[Embodiment], factors: np.ndarray) -> Callable[..., Array]:
    """Loops, with a gradient of their own on GPUs, if the links that correspond lie in order."""
    by_pairs, walk = _by_pairs(arms, factors), long_chain_kernel.plan(arms, factors)
    if walk is None:
        return by_pairs

    def values(wanted: tuple[int, ...]) -> Values:
        def differentiated(*motion: Array) -> tuple[Array, ...]:
            value, gradients = jax.value_and_grad(by_pairs, wanted)(*motion) if wanted else (by_pairs(*motion), ())
            return value[None], *gradients

        return fused_kernel.batched_by(long_chain_kernel.gpu_kernel(walk, wanted), differentiated)

    return _with_gradient(values)


def _with_gradient(values: Callable[[tuple[int, ...]], Values]) -> Callable[..., Array]:
    """The distance, of what makes a function that gives it, [1], and its gradient by the wanted of its arguments."""
    values = functools.cache(values)

    @jax.custom_jvp
    def distance(*motion: Array) -> Array:
        return values(())(*motion)[0][0]

    @functools.partial(distance.defjvp, symbolic_zeros=True)
    def derivative(motion: Any, tangents: Any) -> tuple[Array, Array]:
        wanted = tuple(k for k, tangent in enumerate(tangents) if not isinstance(tangent, SymbolicZero))
        value, *gradients = values(wanted)(*motion)
        along = [jnp.sum(gradient * tangents[k]) for k, gradient in zip(wanted, gradients, strict=True)]
        return value[0], sum(along, jnp.zeros_like(value[0]))

    return distance


def _of_length_one(arm: Embodiment) -> Embodiment:
    """The arm in units of its chain length."""
    arm = jax.tree.map(lambda leaf: np.asarray(leaf, float), arm)
    length = arm.chain_length
    return dataclasses.replace(
        arm,
        joint_anchor=arm.joint_anchor / length,
        link_position=arm.link_position / length,
        link_lengths=arm.link_lengths / length,
        segment_start=arm.segment_start / length,
        segment_end=arm.segment_end / length,
    )
