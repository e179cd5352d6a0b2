"""A policy's rollout as it is shown: resampled in time, with its distance, bound and what each link adds."""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from mimic.evaluation.evaluator import Evaluator, Rollouts
from mimic.metric.kinematics import link_states


def demonstration_index(evaluator: Evaluator, split: str, demonstration: int) -> int:
    """Which of all demonstrations one of a split is.

    Raises:
      ValueError: there is no such one.
    """
    part = evaluator.parts[split]
    which = range(evaluator.env.demonstrations.count)[part]
    if not 0 <= demonstration < len(which):
        raise ValueError(
            f"demonstration: expected 0 to {len(which) - 1}, the {split} ones of the run, got {demonstration}"
        )
    return which[demonstration]


class RolloutFrames:
    """One rollout, resampled for pictures.

    Attributes:
      time: [frames] [s].
      expert, learner: [frames, joints] [rad].
      distance, bound, hold: [T] after each control step.
      links: [T, expert links, learner links] weighted distance of every pair of links.
      matrix: [T, expert links, learner links] correspondence.
      by_link: [T, learner links] share of each in the distance.
    """

    def __init__(self, evaluator: Evaluator, rollouts: Rollouts, index: int, frames_per_second: int):
        env, demonstrations = evaluator.env, evaluator.env.demonstrations
        horizon, dt = env.config.horizon, env.config.control_dt
        home = np.asarray(env.learner.home)[None]
        qpos = np.concatenate([home, np.asarray(rollouts.qpos[index])])
        qvel = np.concatenate([0 * home, np.asarray(rollouts.qvel[index])])
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
    """Angles at any time: cubics through angles and velocities."""
    step = np.minimum((time / dt).astype(int), len(qpos) - 2)
    s = (time / dt - step)[:, None]
    start, end, out, into = qpos[step], qpos[step + 1], dt * qvel[step], dt * qvel[step + 1]
    return (
        (2 * s**3 - 3 * s**2 + 1) * start + (3 * s**2 - 2 * s**3) * end + (s**3 - 2 * s**2 + s) * out
        + (s**3 - s**2) * into
    )  # fmt: skip


def _links(evaluator: Evaluator, index: int, qpos: np.ndarray, qvel: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Link distances D' and correspondence W after each step."""
    env = evaluator.env

    def one(qpos: jax.Array, qvel: jax.Array, step: jax.Array) -> tuple[jax.Array, jax.Array]:
        learner = link_states(env.learner, qpos, qvel)
        distances = env.metric.link_distances(env.expert_at(jnp.asarray(index), step), learner)
        return distances, env.metric.matrix(distances)

    links, matrix = jax.jit(jax.vmap(one))(qpos, qvel, jnp.arange(1, len(qpos) + 1))
    return np.asarray(links), np.asarray(matrix)
