"""Retargeting: demonstrations of one arm as motions of another, pose by pose."""

import functools
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from rich.console import Console
from rich.table import Table

from mimic.arms.arm import rated_speed
from mimic.arms.embodiment import Embodiment
from mimic.commands.config import RetargetConfig
from mimic.commands.progress import similarity_table
from mimic.config import new_file
from mimic.envs import env_config
from mimic.envs.demonstrations import Demonstrations, load_demonstrations
from mimic.evaluation.rollout_metrics import pose_similarity
from mimic.metric.config import MetricConfig
from mimic.retargeting.motions import largest_jump, optimal_motions
from mimic.retargeting.pose import pose_limits
from mimic.trainers.pose_mapper.model import PoseMapper


def retarget(
    demonstrations: Demonstrations,
    expert: Embodiment,
    learner: Embodiment,
    metric: MetricConfig,
    *,
    mapper: PoseMapper | None = None,
    seed: int = 0,
) -> tuple[Demonstrations, dict[str, Any]]:
    """The learner's motions that are nearest to the expert's, without a jump.

    No joint moves faster than its rated speed, pi rad/s where it has none. Velocities are central differences.

    Args:
      demonstrations: the expert's.
      expert: n joints.
      learner: n_hat joints.
      metric: what near means; velocities do not count.
      mapper: proposes the poses, see `follow_mapper`; the optimiser does where None, see `imitate_trajectory`.
      seed: of the random poses that the optimiser searches minima from.

    Returns:
      The learner's motions, and a report: `distance`, mean of all; `largest_jump` [rad] of a joint between two times;
      `settled`, the fraction of poses at a minimum, or at one that the mapper proposes; `similarity` of the motions and
      of `mimic.retargeting.pose_baselines.BASELINES`, means of the measures of `mimic.metric.similarity`.

    Raises:
      ValueError: demonstrations of another arm, poses outside its range, or a mapper between other arms.
    """
    _check(demonstrations, expert)
    rated, jump = rated_speed(learner), largest_jump(learner, demonstrations.dt)
    expert_qpos = jnp.asarray(demonstrations.qpos, jnp.float32)
    if mapper is None:
        found = optimal_motions(expert, learner, expert_qpos, metric, jump, seed)
        qpos, distance, settled = (np.asarray(x) for x in (found.qpos, found.distance, found.converged))
    else:
        mapper.check_fits(expert, learner)
        qpos, distance, settled = follow_mapper(mapper, expert_qpos, jump)
    qpos = np.asarray(qpos, float)
    velocity = np.gradient(qpos, demonstrations.dt, axis=1)
    motions = Demonstrations(
        qpos=qpos,
        qvel=np.clip(velocity, -rated, rated),  # angles came in float32, whose rounding may lift a bounded jump
        goals=qpos[:, -1],
        dt=demonstrations.dt,
        arm=learner.name,
        joint_names=learner.joint_names,
        seed=demonstrations.seed,
    )
    report = {
        "distance": float(np.mean(distance)),
        "largest_jump": float(np.abs(np.diff(qpos, axis=1)).max()),
        "settled": float(np.mean(settled)),
        "similarity": pose_similarity(expert, learner, demonstrations.qpos, {"retargeted": qpos}),
    }
    return motions, report


def follow_mapper(
    mapper: PoseMapper, qpos: Float[Array, "motions time joints"], largest_jump: Float[np.ndarray, " learner_joints"]
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Motions through the poses that a mapper proposes.

    At each time one head's pose is chosen, such that the whole motion has the least sum of distances and of what jumps
    exceed their bound [rad] (dynamic programming). Where a jump is left, the joints go there at their bound.

    Args:
      mapper: of the arm.
      qpos: the expert's motions [rad].
      largest_jump: of each joint between two times [rad].

    Returns:
      The learner's poses [motions, time, learner_joints], their distances, and whether each is the proposed one.
    """
    model = mapper.model
    candidates = jax.jit(jax.vmap(jax.vmap(functools.partial(model.candidates, mapper.params))))(qpos)
    distances = jax.jit(jax.vmap(jax.vmap(jax.vmap(model.distance, (None, 0)))))(qpos, candidates)
    full_turn = np.isinf(pose_limits(model.learner, np.float32)[0])

    def turn(change: Array) -> Array:
        return jnp.where(full_turn, change - 2 * jnp.pi * jnp.round(change / (2 * jnp.pi)), change)

    def one(candidates: Array, distances: Array) -> tuple[Array, Array]:
        def forth(cost: Array, now: tuple[Array, Array, Array]) -> tuple[Array, Array]:
            before, after, distance = now
            change = jnp.abs(turn(after[None] - before[:, None]))
            total = cost[:, None] + jnp.maximum(change - largest_jump, 0).sum(axis=-1)
            return total.min(axis=0) + distance, total.argmin(axis=0)

        cost, origin = jax.lax.scan(forth, distances[0], (candidates[:-1], candidates[1:], distances[1:]))
        last = cost.argmin()
        _, chosen = jax.lax.scan(lambda head, from_: (from_[head], from_[head]), last, origin, reverse=True)
        chosen = jnp.append(chosen, last)
        proposed = jnp.take_along_axis(candidates, chosen[:, None, None], axis=1)[:, 0]

        def follow(pose: Array, target: Array) -> tuple[Array, tuple[Array, Array]]:
            change = turn(target - pose)
            bounded = jnp.clip(change, -largest_jump, largest_jump)
            return pose + bounded, (pose + bounded, jnp.all(bounded == change))

        _, (poses, settled) = jax.lax.scan(follow, proposed[0], proposed)
        return poses, settled

    poses, settled = jax.jit(jax.vmap(one))(candidates, distances)
    distance = jax.jit(jax.vmap(jax.vmap(model.distance)))(qpos, poses)
    return np.asarray(poses), np.asarray(distance), np.asarray(settled)


def prepare_retargeting(config: RetargetConfig) -> Callable[[], None]:
    """What retargets a file of demonstrations, says how well it went, and writes the result.

    Raises:
      ValueError: a name that is missing, an `out` that exists, a file or an environment that does not fit.
    """
    if not config.demonstrations:
        raise ValueError("demonstrations: expected a file, as in demonstrations=FILE")
    out = new_file("out", config.out)
    env = env_config(config.learner, limits=config.limits)
    expert, learner = env.build_arms().embodiments
    loaded = load_demonstrations(Path(config.demonstrations).expanduser())
    _check(loaded, expert)
    mapper = PoseMapper.load(Path(config.mapper).expanduser()) if config.mapper else None
    if mapper:
        mapper.check_fits(expert, learner)

    def run() -> None:
        console = Console()
        with console.status(f"retargeting {loaded.count} motions from {expert.name} to {learner.name}"):
            motions, report = retarget(loaded, expert, learner, env.metric, mapper=mapper, seed=config.seed)
        motions.save(out)
        console.print(_table(motions, report))
        console.print(similarity_table(report["similarity"]))
        console.print(f"results: {out}", soft_wrap=True, highlight=False)

    return run


def _check(demonstrations: Demonstrations, arm: Embodiment) -> None:
    """Refuses demonstrations of another arm, and poses outside of its range."""
    demonstrations.check_fits(arm, demonstrations.dt, demonstrations.horizon)
    lower, upper = np.asarray(arm.joint_range).T
    outside = (demonstrations.qpos < lower - 1e-6) | (demonstrations.qpos > upper + 1e-6)
    if outside.any():
        which, time, joint = np.argwhere(outside)[0]
        raise ValueError(
            f"demonstrations: {arm.joint_names[joint]} of demonstration {which} is at "
            f"{demonstrations.qpos[which, time, joint]:.4f} rad at sample {time}, outside of its range "
            f"[{lower[joint]:.4f}, {upper[joint]:.4f}]"
        )


def _table(motions: Demonstrations, report: Mapping[str, Any]) -> Table:
    table = Table("", "value", title=f"{motions.count} motions of {motions.arm}", title_justify="left")
    table.add_row("mean distance", f"{report['distance']:.4f}")
    table.add_row("largest jump of a joint", f"{report['largest_jump']:.3f} rad in {motions.dt} s")
    table.add_row("poses at a minimum, or as mapped", f"{report['settled']:.1%}")
    return table
