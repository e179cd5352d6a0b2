"""Motions of a learner that resemble those of an expert under a metric, one trajectory at a time."""

from collections.abc import Iterator, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from mimic.arms.arm import finite_velocity_limit
from mimic.arms.capsules import Capsules
from mimic.arms.embodiment import Embodiment
from mimic.metric.config import MetricConfig
from mimic.retargeting.costs import Costs
from mimic.retargeting.exact_chunks import in_threads
from mimic.retargeting.exact_pose import SET
from mimic.retargeting.exact_trajectory import exact_trajectories
from mimic.retargeting.hand_target import placement
from mimic.retargeting.initial_guesses import random_poses
from mimic.retargeting.pose import STARTS, PoseImitation, check_hand
from mimic.retargeting.trajectory import imitate_trajectory

_SHORTEST = 64  # times to which a motion is padded


def largest_jump(arm: Embodiment, dt: float) -> Float[np.ndarray, " joints"]:
    """Maximum change of each joint [rad] in a time [s], at its velocity limit."""
    return finite_velocity_limit(arm) * dt


def optimal_motions(
    expert: Embodiment,
    learner: Embodiment,
    qpos: Array,
    metric: MetricConfig,
    largest_jump: np.ndarray,
    seed: int,
    **costs: Any,
) -> PoseImitation:
    """`imitate_trajectory` of each of the expert's motions [motions, time, joints], with its `costs` and `capsules`."""
    arguments = metric.build(expert, learner).arguments

    def imitate(qpos: jax.Array) -> PoseImitation:
        return imitate_trajectory(
            expert,
            learner,
            qpos,
            largest_jump=largest_jump,
            key=jax.random.key(seed),
            **arguments,
            **costs,
        )

    # One demonstration after the other: the tracked minima already fill the processor, and memory stays small.
    return jax.jit(lambda all_qpos: jax.lax.map(imitate, all_qpos))(qpos)


def retarget_motions(
    expert: Embodiment,
    learner: Embodiment,
    motions: Sequence[Float[np.ndarray, "time joints"]],
    metric: MetricConfig,
    *,
    hand: str = "exact",
    base: Sequence[float] | None = None,
    largest_jump: Float[np.ndarray, " learner_joints"],
    seed: int = 0,
    costs: Costs | None = None,
    capsules: Capsules | None = None,
) -> Iterator[Float[np.ndarray, "time learner_joints"]]:
    """The learner's motion [rad] for each of the expert, of any lengths.

    Args:
      expert: n joints.
      learner: n_hat joints.
      motions: [T, n] each, the expert's [rad].
      metric: chooses among the postures, or the motion with hand="scaled".
      hand: "exact" or "near" for the expert's hand in metres, or the nearest one; "scaled" for the metric alone, in
        chain lengths.
      base: the learner's base in the expert's base frame, [x, y, z, yaw] [m, rad]; None for the same.
      largest_jump: maximum change of each joint between two times [rad].
      seed: of the random initial poses.
      costs, capsules: see `imitate_trajectory`.

    Raises:
      ValueError: what `imitate_trajectory` rejects.
    """
    built, key, costs = metric.build(expert, learner), jax.random.key(seed), Costs() if costs is None else costs
    if hand != "scaled":
        check_hand("exact", base, expert, learner)
        costs.check_capsules(capsules)
        jump = np.asarray(largest_jump, np.float32)
        random = random_poses(learner, key, STARTS["exact"], np.float32, SET)
        arguments = placement(base), jump, random, costs, capsules if costs.of_capsules else None
        poses = [np.asarray(qpos, np.float32) for qpos in motions]
        for path in exact_trajectories(expert, learner, built, poses, *arguments):
            yield np.asarray(path.qpos, float)
        return

    def scaled(qpos: np.ndarray) -> np.ndarray:  # padded, so that motions of similar lengths share what is compiled
        length = max(_SHORTEST, 1 << (len(qpos) - 1).bit_length())
        padded = qpos[np.minimum(np.arange(length), len(qpos) - 1)]
        solution = imitate_trajectory(
            expert, learner, jnp.asarray(padded, jnp.float32), largest_jump=largest_jump, key=key, costs=costs,
            capsules=capsules, **built.arguments,
        )  # fmt: skip
        return np.asarray(solution.qpos, float)[: len(qpos)]

    yield from in_threads(scaled, motions)
