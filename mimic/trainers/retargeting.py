"""Retargeting: demonstrations of one arm as motions of another, pose by pose."""

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from rich.console import Console
from rich.table import Table

from mimic.embodiment import Embodiment
from mimic.envs import env_config
from mimic.envs.arms import build_arm
from mimic.envs.config import MetricConfig, RetargetConfig
from mimic.envs.demonstrations import Demonstrations, load_demonstrations
from mimic.pose import imitate_trajectory


def retarget(
    demonstrations: Demonstrations, expert: Embodiment, learner: Embodiment, metric: MetricConfig, *, seed: int = 0
) -> tuple[Demonstrations, dict[str, Any]]:
    """The learner's motions that are nearest to the expert's, without a jump (see `imitate_trajectory`).

    No joint moves faster than its rated speed, pi rad/s where it has none. Velocities are central differences.

    Args:
      demonstrations: the expert's.
      expert: n joints.
      learner: n_hat joints.
      metric: what near means; velocities do not count.
      seed: of the random poses that minima are searched from.

    Returns:
      The learner's motions, and a report: `distance`, mean of all; `largest_jump` [rad] of a joint between two times;
      `converged`, the share of poses at a minimum.

    Raises:
      ValueError: demonstrations of another arm, or poses outside its range.
    """
    _check(demonstrations, expert)
    correspondence, weights = metric.make_correspondence(expert, learner), metric.make_weights()
    rated = np.where(np.isfinite(learner.velocity_limit), learner.velocity_limit, np.pi)

    def one(qpos: jax.Array) -> Any:
        return imitate_trajectory(
            expert,
            learner,
            qpos,
            correspondence,
            weights,
            largest_jump=rated * demonstrations.dt,
            key=jax.random.key(seed),
            rotation=metric.rotation_measure,  # type: ignore[arg-type]
            reduction=metric.reduction,  # type: ignore[arg-type]
        )

    # One demonstration after the other: the minima that are tracked fill the processor, and memory stays small.
    found = jax.jit(lambda all_qpos: jax.lax.map(one, all_qpos))(jnp.asarray(demonstrations.qpos, jnp.float32))
    qpos = np.asarray(found.qpos, float)
    motions = Demonstrations(
        qpos=qpos,
        qvel=np.gradient(qpos, demonstrations.dt, axis=1),
        goals=qpos[:, -1],
        dt=demonstrations.dt,
        arm=learner.name,
        joint_names=learner.joint_names,
        seed=demonstrations.seed,
    )
    report = {
        "distance": float(np.mean(found.distance)),
        "largest_jump": float(np.abs(np.diff(qpos, axis=1)).max()),
        "converged": float(np.mean(found.converged)),
    }
    return motions, report


def prepare_retargeting(config: RetargetConfig) -> Callable[[], None]:
    """What retargets a file of demonstrations, says how well it went, and writes the result.

    Raises:
      ValueError: a name that is missing, an `out` that exists, a file or an environment that does not fit.
    """
    for name in ("demonstrations", "out"):
        if not getattr(config, name):
            raise ValueError(f"{name}: expected a file, as in {name}=FILE")
    out = Path(config.out).expanduser()
    if out.exists() or not out.parent.is_dir():
        reason = "exists; name a new file" if out.exists() else f"there is no folder {str(out.parent)!r}"
        raise ValueError(f"out: {str(out)!r}: {reason}")
    env = env_config(config.learner, limits=config.limits)
    expert, learner = (build_arm(arm, env.limits).embodiment for arm in (env.expert, env.learner))
    loaded = load_demonstrations(Path(config.demonstrations).expanduser())
    _check(loaded, expert)

    def run() -> None:
        console = Console()
        with console.status(f"retargeting {loaded.count} motions from {expert.name} to {learner.name}"):
            motions, report = retarget(loaded, expert, learner, env.metric, seed=config.seed)
        motions.save(out)
        console.print(_table(motions, report))
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
    table.add_row("poses at a minimum", f"{report['converged']:.1%}")
    return table
