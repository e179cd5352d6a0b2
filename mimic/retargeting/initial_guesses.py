"""Initial guesses of pose imitation: the nearest of random poses."""

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from mimic.arms.arrays import ArmArrays
from mimic.arms.embodiment import Embodiment
from mimic.base.compilation import UNOPTIMIZED, by_value, compiled_quickly, has_tracer
from mimic.base.spatial import array_library
from mimic.metric.kinematics import LinkStates, link_state_table, link_states
from mimic.retargeting.pose_objective import PoseObjective, Target

_POSES = 256  # random poses whose distances are compared to choose the initial guesses
_TYPICAL_POSES = 16  # at least; of these, whose mean distance is the scale of the metric

_Shape = tuple[int, int, int]  # sets, poses, joints


class RandomPoses(NamedTuple):
    """Random poses of the learner, candidates for initial guesses.

    Attributes:
      qpos: [sets, poses, joints] [rad].
      states: link states of these poses, each [sets, poses, links, 3].
    """

    qpos: Float[Any, "sets poses joints"]
    states: LinkStates


def random_poses(
    arm: Embodiment | ArmArrays, key: Array | None, sets: int, dtype: Any, in_set: int | None = None
) -> RandomPoses:
    """Sets of random poses, uniform in the joint ranges; computed once for equal arguments.

    Args:
      arm: the embodiment.
      key: `jax.random.key(0)` where None.
      sets: number of sets.
      dtype: of the result.
      in_set: number of poses in each set; where None, 256 in all sets.
    """
    shape = sets, in_set or -(-_POSES // sets), arm.num_joints
    if has_tracer((arm, key)):
        return _traced_poses(arm, key, shape, dtype)
    return _constant_poses(arm, key, shape, jnp.dtype(dtype))


def _traced_poses(arm: Embodiment | ArmArrays, key: Array | None, shape: _Shape, dtype: Any) -> RandomPoses:
    qpos = _uniform(shape, key, *_range(arm, dtype))
    return RandomPoses(qpos, jax.vmap(jax.vmap(lambda q: link_states(arm, q)))(qpos))


@by_value
def _constant_poses(arm: Embodiment | ArmArrays, key: Array | None, shape: _Shape, dtype: Any) -> RandomPoses:
    """By NumPy, because the kinematics would take half a second to compile."""
    uniform = _compiled_uniform(shape, None if key is None else jax.ShapeDtypeStruct(key.shape, key.dtype), dtype)
    with jax.ensure_compile_time_eval():
        qpos = np.asarray(uniform(key, *_range(arm, dtype)))
        if isinstance(arm, ArmArrays):
            return RandomPoses(qpos, jax.tree.map(np.asarray, _states_of_poses(arm.astype(dtype), qpos)))
    return RandomPoses(qpos, link_state_table(arm, qpos, np.zeros_like(qpos), dtype))


@jax.jit
def _states_of_poses(arm: ArmArrays, qpos: Array) -> LinkStates:
    """Link states of sets of poses of an arm as data, compiled once for all arms."""
    return jax.vmap(jax.vmap(functools.partial(link_states, arm)))(qpos)


@by_value
def _compiled_uniform(shape: tuple[int, ...], key: jax.ShapeDtypeStruct | None, dtype: Any) -> Callable[..., Array]:
    limit = jax.ShapeDtypeStruct(shape[-1:], dtype)
    return compiled_quickly(functools.partial(_uniform, shape), key, limit, limit, options=UNOPTIMIZED)


def _uniform(shape: tuple[int, ...], key: Array | None, lower: Any, upper: Any) -> Array:
    key = jax.random.key(0) if key is None else key
    return jax.random.uniform(key, shape, lower.dtype, minval=lower, maxval=upper)


def _range(arm: Embodiment | ArmArrays, dtype: Any) -> tuple[Any, Any]:
    """Angles of random poses; both at home for joints locked by a mask."""
    if isinstance(arm, ArmArrays):
        free = arm.is_free > 0
        limits = (array_library(arm.home).where(free, arm.joint_range[:, side], arm.home) for side in (0, 1))
        return next(limits).astype(dtype), next(limits).astype(dtype)
    lower, upper = np.asarray(arm.joint_range, dtype).T
    return lower, upper


def typical_distance(objective: PoseObjective, target: Target, candidates: RandomPoses) -> Float[Array, ""]:
    """Mean distance of random poses to a pose of the expert: the scale of the metric."""
    count = -(-_TYPICAL_POSES // candidates.qpos.shape[0])
    some = jax.tree.map(lambda x: jnp.asarray(x[:, :count]), candidates.states)
    return jax.vmap(jax.vmap(functools.partial(objective.value, target)))(some).mean()


def initial_guesses(
    objective: PoseObjective, target: Target, first: Float[Array, " joints"], candidates: RandomPoses | None
) -> Float[Array, "guesses joints"]:
    """A first guess, then the nearest of each set of random poses."""
    if candidates is None:
        return first[None]
    values = jax.vmap(jax.vmap(lambda states: objective.value(target, states)))(candidates.states)
    nearest = jnp.take_along_axis(candidates.qpos, jnp.argmin(values, axis=1)[:, None, None], axis=1)[:, 0]
    return jnp.concatenate([first[None], nearest])
