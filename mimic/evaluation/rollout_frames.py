"""A policy's rollout for pictures and videos: resampled in time, with its distance, bound and each link's part."""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from mimic.evaluation.evaluator import Evaluator, Rollouts
from mimic.metric.kinematics import link_states


def demonstration_index(evaluator: Evaluator, split: str, demonstration: int) -> int:
    """The index among all demonstrations of a demonstration of a split.

    Raises:
      ValueError: the split has no such demonstration.
    """
    indices = range(evaluator.env.demonstrations.count)[evaluator.parts[split]]
    if not 0 <= demonstration < len(indices):
        raise ValueError(
            f"demonstration: expected 0 to {len(indices) - 1}, the {split} ones of the run, got {demonstration}"
        )
    return indices[demonstration]


class RolloutFrames:
    """One rollout, resampled at the frames of a video.

    Attributes:
      time: [frames] [s].
      expert, learner: [frames, joints] [rad].
      distance, bound, hold: [T] distance, kinematic bound and distance of holding the start pose after each step.
      links: [T, expert links, learner links] weighted distance of every pair of links.
      matrix: [T, expert links, learner links] correspondence.
      by_link: [T, learner links] part of each learner link in the distance.
    """

    def __init__(self, evaluator: Evaluator, rollouts: Rollouts, index: int, frames_per_second: int):
        env, demonstrations = evaluator.env, evaluator.env.demonstrations
        horizon, dt = env.config.horizon, env.config.control_dt
        starts = env.start_poses if rollouts.start is None else np.asarray(rollouts.start)
        start = starts[index][None]
        qpos = np.concatenate([start, np.asarray(rollouts.qpos[index])])
        qvel = np.concatenate([0 * start, np.asarray(rollouts.qvel[index])])
        span = slice(0, horizon + 1)
        self.dt = dt
        self.time = np.arange(0, horizon * dt + 1e-9, 1 / frames_per_second)
        self.expert = interpolate(demonstrations.qpos[index, span], demonstrations.qvel[index, span], dt, self.time)
        self.learner = interpolate(qpos, qvel, dt, self.time)
        self.distance = np.asarray(rollouts.distance[index])
        self.bound, self.hold = evaluator.lower_bound[index], evaluator.hold_distance[index]
        self.links, self.matrix = _links(evaluator, index, qpos[1:], qvel[1:])
        self.by_link = (self.matrix * self.links).sum(axis=1) / self.links[0].size
        self.link_names = env.learner.link_names
        self.num_frames = len(self.time)


def interpolate(
    qpos: Float[np.ndarray, "samples joints"], qvel: Float[np.ndarray, "samples joints"], dt: float, time: np.ndarray
) -> Float[np.ndarray, "frames joints"]:
    """Angles at any time, by a cubic Hermite spline through angles and velocities at multiples of dt."""
    from scipy.interpolate import CubicHermiteSpline  # takes half a second to import

    return CubicHermiteSpline(dt * np.arange(len(qpos)), qpos, qvel)(time)


def _links(evaluator: Evaluator, index: int, qpos: np.ndarray, qvel: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Link distances D' and correspondence W after each step, [T, expert links, learner links] each."""
    env = evaluator.env

    def at_step(qpos: jax.Array, qvel: jax.Array, step: jax.Array) -> tuple[jax.Array, jax.Array]:
        learner = link_states(env.learner, qpos, qvel)
        distances = env.metric.link_distances(env.expert_at(jnp.asarray(index), step), learner)
        return distances, env.metric.matrix(distances)

    links, matrix = jax.jit(jax.vmap(at_step))(qpos, qvel, jnp.arange(1, len(qpos) + 1))
    return np.asarray(links), np.asarray(matrix)
