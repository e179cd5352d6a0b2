"""`python -m mimic.retarget`: a data set or demonstrations of one arm as those of another."""

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from rich.console import Console
from rich.table import Table

from mimic.arms.arm import finite_velocity_limit
from mimic.arms.capsules import Capsules, fit_capsules
from mimic.arms.embodiment import Embodiment
from mimic.arms.pose_limits import continuous_joints, pose_limits
from mimic.base.compilation import use_compilation_cache
from mimic.base.config import new_file
from mimic.commands.config import RetargetConfig
from mimic.commands.retarget_data import prepare_data_set
from mimic.evaluation.rollout_metrics import pose_similarity
from mimic.metric.config import MetricConfig
from mimic.motions.demonstrations import Demonstrations, load_demonstrations
from mimic.retargeting.costs import Costs
from mimic.retargeting.motions import largest_jump, optimal_motions
from mimic.retargeting.pose import wrap_angles
from mimic.trainers.pose_mapper.mapper import PoseMapper
from mimic.trainers.progress import similarity_table


# Above 40 lines because of its docstring.
def retarget(
    demonstrations: Demonstrations,
    expert: Embodiment,
    learner: Embodiment,
    metric: MetricConfig,
    *,
    mapper: PoseMapper | None = None,
    seed: int = 0,
    costs: Costs | None = None,
    capsules: Capsules | None = None,
) -> tuple[Demonstrations, dict[str, Any]]:
    """Retargets demonstrations of the expert to the learner, pose by pose, with bounded joint velocities.

    No joint exceeds its velocity limit, or pi rad/s where the limit is unknown. Velocities are central differences.

    Args:
      demonstrations: demonstrations of the expert.
      expert: arm with n joints.
      learner: arm with n_hat joints.
      metric: metric to minimise; its weights on velocities are ignored.
      mapper: proposes the poses, see `follow_mapper`. Default None: the optimiser, see `imitate_trajectory`.
      seed: seed of the random initial poses of the optimiser.
      costs: see `imitate_trajectory`; of the optimiser.
      capsules: see `imitate_trajectory`.

    Returns:
      The learner's motions, and a report: `distance`, the mean over all poses; `largest_jump` [rad], the maximum change
      of a joint in a time step; `settled`, the fraction of poses at a minimum, or at a pose proposed by the mapper;
      `similarity`, means of the measures of `mimic.metric.similarity` for the motions and for
      `mimic.retargeting.pose_baselines.BASELINES`.

    Raises:
      ValueError: the demonstrations belong to another arm or leave its joint range, or the mapper is for other arms.
    """
    check_poses(demonstrations, expert)
    jump = largest_jump(learner, demonstrations.dt)
    expert_qpos = jnp.asarray(demonstrations.qpos, jnp.float32)
    if mapper is None:
        solution = optimal_motions(expert, learner, expert_qpos, metric, jump, seed, costs=costs, capsules=capsules)
        learner_qpos, distance, settled = solution.qpos, solution.distance, solution.converged
    else:
        mapper.check_fits(expert, learner)
        learner_qpos, distance, settled = follow_mapper(mapper, expert_qpos, jump)
    qpos = np.asarray(learner_qpos, float)
    report = {
        "distance": float(np.mean(np.asarray(distance))),
        "largest_jump": float(np.abs(np.diff(qpos, axis=1)).max()),
        "settled": float(np.mean(np.asarray(settled))),
        "similarity": pose_similarity(expert, learner, demonstrations.qpos, {"retargeted": qpos}),
    }
    return _motions(learner, qpos, demonstrations.dt, demonstrations.seed), report


def _motions(learner: Embodiment, qpos: np.ndarray, dt: float, seed: int) -> Demonstrations:
    limit, velocity = finite_velocity_limit(learner), np.gradient(qpos, dt, axis=1)
    return Demonstrations(
        qpos=qpos,
        qvel=np.clip(velocity, -limit, limit),  # float32 rounding may lift a jump above its bound
        goals=qpos[:, -1],
        dt=dt,
        arm=learner.name,
        joint_names=learner.joint_names,
        seed=seed,
    )


def follow_mapper(
    mapper: PoseMapper, qpos: Float[Array, "motions time joints"], largest_jump: Float[np.ndarray, " learner_joints"]
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Computes motions through the poses that a pose mapper proposes.

    The mapper has several candidates for each time step. Dynamic programming selects one at each step, such that
    the sum over the motion of the distances and of the jumps' excess over `largest_jump` [rad] is minimal. Jumps that
    still exceed their bound are cut off at it.

    Args:
      mapper: pose mapper between the two arms.
      qpos: the expert's motions [rad].
      largest_jump: maximum change of each joint in a time step [rad].

    Returns:
      The learner's poses [motions, time, learner_joints] [rad], their distances [motions, time], and whether each pose
      equals the proposed one [motions, time].
    """
    candidates = jax.jit(jax.vmap(jax.vmap(mapper.candidates)))(qpos)
    distances = jax.jit(jax.vmap(jax.vmap(jax.vmap(mapper.distance, (None, 0)))))(qpos, candidates)
    continuous = continuous_joints(mapper.learner)

    def motion(candidates: Array, distances: Array) -> tuple[Array, Array]:
        selected = _select_candidates(candidates, distances, largest_jump, continuous)
        proposed = jnp.take_along_axis(candidates, selected[:, None, None], axis=1)[:, 0]

        def follow(pose: Array, target: Array) -> tuple[Array, tuple[Array, Array]]:
            change = wrap_angles(target - pose, continuous)
            bounded = jnp.clip(change, -largest_jump, largest_jump)
            return pose + bounded, (pose + bounded, jnp.all(bounded == change))

        _, (poses, settled) = jax.lax.scan(follow, proposed[0], proposed)
        return poses, settled

    poses, settled = jax.jit(jax.vmap(motion))(candidates, distances)
    distance = jax.jit(jax.vmap(jax.vmap(mapper.distance)))(qpos, poses)
    return np.asarray(poses), np.asarray(distance), np.asarray(settled)


def _select_candidates(candidates: Array, distances: Array, largest_jump: np.ndarray, continuous: np.ndarray) -> Array:
    """The candidate [time] of the mapper for each step of a motion, by dynamic programming; see `follow_mapper`."""

    def extend(cost: Array, step: tuple[Array, Array, Array]) -> tuple[Array, Array]:
        previous, current, distance = step
        change = jnp.abs(wrap_angles(current[None] - previous[:, None], continuous))
        total = cost[:, None] + jnp.maximum(change - largest_jump, 0).sum(axis=-1)
        return total.min(axis=0) + distance, total.argmin(axis=0)

    cost, predecessors = jax.lax.scan(extend, distances[0], (candidates[:-1], candidates[1:], distances[1:]))
    last = cost.argmin()
    _, selected = jax.lax.scan(lambda after, row: (row[after], row[after]), last, predecessors, reverse=True)
    return jnp.append(selected, last)


def prepare_retargeting(config: RetargetConfig) -> Callable[[], int | None]:
    """Checks the config of a retargeting and loads its files.

    Raises:
      ValueError: a file name is missing, `out` exists, or a file belongs to other arms.
    """
    use_compilation_cache(config.compilation_cache)
    if config.source:
        return prepare_data_set(config)
    if not config.demonstrations:
        raise ValueError(
            "source, demonstrations: expected a data set or a file of demonstrations, as in source=FOLDER or "
            "demonstrations=FILE"
        )
    out = new_file("out", config.out)
    env = config.resolve()
    expert, learner = env.build_arms().embodiments
    demonstrations = load_demonstrations(Path(config.demonstrations).expanduser())
    check_poses(demonstrations, expert)
    capsules = fit_capsules(env.learner, env.limits) if config.costs.of_capsules else None
    mapper = None
    if config.mapper:
        mapper = PoseMapper.load(Path(config.mapper).expanduser())
        mapper.check_fits(expert, learner)

    def run() -> None:
        console = Console()
        with console.status(f"retargeting {demonstrations.count} motions from {expert.name} to {learner.name}"):
            options = {"mapper": mapper, "seed": config.seed, "costs": config.costs, "capsules": capsules}
            motions, report = retarget(demonstrations, expert, learner, env.metric, **options)
        motions.save(out)
        console.print(_table(motions, report))
        console.print(similarity_table(report["similarity"]))
        console.print(f"results: {out}", soft_wrap=True, highlight=False)

    return run


def check_poses(demonstrations: Demonstrations, arm: Embodiment) -> None:
    """Raises a `ValueError` for demonstrations of another arm, and for poses outside its joint range.

    Joints that turn freely have none.
    """
    demonstrations.check_fits(arm, demonstrations.dt, demonstrations.horizon)
    lower, upper = pose_limits(arm, float)
    outside = (demonstrations.qpos < lower - 1e-6) | (demonstrations.qpos > upper + 1e-6)
    if outside.any():
        demonstration, sample, joint = np.argwhere(outside)[0]
        raise ValueError(
            f"demonstrations: {arm.joint_names[joint]} of demonstration {demonstration} is at "
            f"{demonstrations.qpos[demonstration, sample, joint]:.4f} rad at sample {sample}, outside its range "
            f"[{lower[joint]:.4f}, {upper[joint]:.4f}]"
        )


def _table(motions: Demonstrations, report: Mapping[str, Any]) -> Table:
    table = Table("", "value", title=f"{motions.count} motions of {motions.arm}", title_justify="left")
    table.add_row("mean distance", f"{report['distance']:.4f}")
    table.add_row("maximum jump of a joint", f"{report['largest_jump']:.3f} rad in {motions.dt} s")
    table.add_row("poses at a minimum, or as proposed", f"{report['settled']:.1%}")
    return table
