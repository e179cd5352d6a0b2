"""The embodiment distance as a function of the joint angles and velocities of two arms."""

import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jax.custom_derivatives import SymbolicZero
from jaxtyping import Array, Float

from mimic.arms.arrays import ArmArrays
from mimic.arms.embodiment import LONG, Embodiment, in_chain_lengths
from mimic.base import fused_kernel
from mimic.base.batches import over_batch
from mimic.metric import analytic_gradient
from mimic.metric.distance import (
    PAPER_WEIGHTS,
    Correspondence,
    Metric,
    Reduction,
    RotationMeasure,
    Weights,
)
from mimic.metric.hand import NO_HAND, HandWeights
from mimic.metric.kinematics import joint_values, link_states

Values = Callable[..., tuple[Array, ...]]  # motions -> distance, gradients
MotionDistance = Callable[..., Float[Array, ""]]  # expert_qpos, expert_qvel, learner_qpos, learner_qvel


# Above 40 lines because of its docstring.
def motion_distance(
    expert: Embodiment | ArmArrays,
    learner: Embodiment | ArmArrays,
    correspondence: Correspondence,
    weights: Weights = PAPER_WEIGHTS,
    *,
    rotation: RotationMeasure = "cosine",
    reduction: Reduction = "mean",
    hand_weights: HandWeights = NO_HAND,
) -> MotionDistance:
    """Returns a function (expert_qpos, expert_qvel, learner_qpos, learner_qvel) -> embodiment distance.

    The function equals `embodiment_distance` of both arms' `link_states`. Batch axes before that of the joints
    broadcast. Create it once for two arms: their constants are then folded into it.

    A static metric (constant W and weights, rotation "cosine", reduction "mean") has its own implementation. It skips
    pairs of links that do not correspond and parts of weight 0. Its gradient is in closed form, in forward and reverse
    mode, and only with respect to the differentiated arguments. A batch of the function, or `jax.vmap` of its gradient,
    is one kernel on NVIDIA GPUs.

    Any other metric, and any metric where an arm has more than 16 joints or is data, composes `link_states` and
    `embodiment_distance`, with automatic differentiation: the unrolled code of long arms takes minutes to compile.

    Args:
      expert: embodiment of the expert.
      learner: embodiment of the learner.
      correspondence: see `embodiment_distance`.
      weights: see `embodiment_distance`.
      rotation: see `embodiment_distance`.
      reduction: see `embodiment_distance`.
      hand_weights: see `embodiment_distance`.

    Returns:
      The function. It raises ValueError if an argument is not [..., joints].

    Raises:
      ValueError: what `embodiment_distance` rejects.
    """
    arms, metric = (expert, learner), Metric(correspondence, weights, rotation, reduction, hand_weights)

    def composed(*motion: Array) -> Array:
        states = link_states(expert, *motion[:2]), link_states(learner, *motion[2:])
        return metric(*states)

    # Validates the arguments for all implementations below.
    jax.eval_shape(composed, *(jax.ShapeDtypeStruct((arm.num_joints,), jnp.float32) for arm in arms for _ in range(2)))
    embodiments = [arm for arm in arms if isinstance(arm, Embodiment) and arm.num_joints <= LONG]
    if len(embodiments) == len(arms) and metric.is_static and _is_constant((arms, metric.arguments)):
        factors = np.asarray(metric.factors(*(len(arm.hand_joint) for arm in embodiments)), float)
        distance = _unrolled([in_chain_lengths(_as_numpy(arm)) for arm in embodiments], factors)
    else:
        distance = composed

    def of_motions(expert_qpos: Any, expert_qvel: Any, learner_qpos: Any, learner_qvel: Any) -> Array:
        motion = [
            joint_values(expert, expert_qpos, "expert_qpos"),
            joint_values(expert, expert_qvel, "expert_qvel"),
            joint_values(learner, learner_qpos, "learner_qpos"),
            joint_values(learner, learner_qvel, "learner_qvel"),
        ]
        dtype = jnp.result_type(*motion)
        return over_batch(distance, *(values.astype(dtype) for values in motion), axes=1)

    return of_motions


def _is_constant(tree: Any) -> bool:
    return not any(isinstance(leaf, Tracer) for leaf in jax.tree.leaves(tree))


def _unrolled(arms: list[Embodiment], factors: np.ndarray) -> Callable[..., Array]:
    """The distance with all links unrolled."""
    joints = [arm.num_joints for arm in arms for _ in range(2)]

    def values(arguments: tuple[int, ...]) -> Values:
        function = functools.partial(analytic_gradient.distance_and_gradient, *arms, factors, arguments)
        return fused_kernel.fused(function, [1, *(joints[k] for k in arguments)])

    return _with_gradient(values)


def _with_gradient(values: Callable[[tuple[int, ...]], Values]) -> Callable[..., Array]:
    """The distance with a custom derivative.

    Args:
      values: returns, for indices of arguments, a function of the motion: the distance [1], and its gradients with
        respect to these arguments.
    """
    values = functools.cache(values)

    @jax.custom_jvp
    def distance(*motion: Array) -> Array:
        return values(())(*motion)[0][0]

    @functools.partial(distance.defjvp, symbolic_zeros=True)
    def derivative(motion: Any, tangents: Any) -> tuple[Array, Array]:
        varied = tuple(k for k, tangent in enumerate(tangents) if not isinstance(tangent, SymbolicZero))
        value, *gradients = values(varied)(*motion)
        terms = [jnp.sum(gradient * tangents[k]) for k, gradient in zip(varied, gradients, strict=True)]
        return value[0], sum(terms, jnp.zeros_like(value[0]))

    return distance


def _as_numpy(arm: Embodiment) -> Embodiment:
    """The arm in float64, with NumPy arrays: constants while JAX traces."""
    return jax.tree.map(lambda leaf: np.asarray(leaf, float), arm)
