"""Steps at which the kinematic bound misses the global minimum, and by how much.

    python -m benchmarks.bound --out FILE [--case NAME] [--seeds 0 1 2]

The reference of a step is the minimum of three searches: the bound itself, Adam from 64 random poses and from the
expert's own angles (200 iterations; the best four refined by 300 more), and `closest_motion` with more starts, more
iterations and another seed. A step is missed if the bound exceeds its reference by 1e-3 in the metric's unit, or by
0.1 % and 1e-5. "paper" is the paper's metric with merged links, "hard" has hard correspondence and adaptive weights.
"""

import dataclasses
from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax

import mimic
from benchmarks.common.parser import make_parser
from benchmarks.common.record import Row, print_table, write_results
from mimic.arms.arm import ArmConfig
from mimic.arms.pose_limits import pose_limits
from mimic.envs.config import EnvConfig
from mimic.metric.config import MetricConfig
from mimic.motions.recording import record_demonstrations
from mimic.retargeting.pose import shared_joints

STEPS = 50
ABSOLUTE, RELATIVE, ROUNDING = 1e-3, 1e-3, 1e-5
STARTS, ITERATIONS, KEPT, REFINEMENT = 64, 200, 4, 300  # of the reference
STEP_SIZES = 0.1, 0.02  # [rad], and for velocities in units of the expert's
MINIMUM_SPEED = 1e-2  # rad/s
MORE: dict[str, Any] = {"starts": 16, "iterations": 40, "seed": 1}
COUNTS = "steps", "missed_absolute", "missed_relative"
COLUMNS = "case steps missed_absolute missed_relative largest_excess:.1e mean_reference:.4f"


def planar(links: int) -> ArmConfig:
    """A planar arm of equal links, 1 m long."""
    return ArmConfig(model="planar", link_lengths=[1 / links] * links)


def _cases() -> dict[str, EnvConfig]:
    four, cases = ArmConfig(locked=[3, 6, 7]), {}
    default, paper = MetricConfig(), MetricConfig(links="merged", correspondence="overlap", translation=0.0)
    for name, metric in {"paper": paper, "default": default}.items():
        hard = dataclasses.replace(metric, correspondence="hard", adaptive=True)
        cases[f"joint 5 locked, {name}"] = EnvConfig(learner=ArmConfig(locked=[5]), metric=metric)
        cases[f"joint 1 locked, {name}"] = EnvConfig(learner=ArmConfig(locked=[1]), metric=metric)
        cases[f"planar 7->4, {name}"] = EnvConfig(expert=planar(7), learner=planar(4), metric=metric)
        cases[f"panda4dof hard, {name}"] = EnvConfig(learner=four, metric=hard)
    cases["panda4dof, default"] = EnvConfig(learner=four)
    return cases | {"panda3dof, default": EnvConfig(learner=ArmConfig(locked=[2, 3, 6, 7]))}


CASES = _cases()


def motions(case: EnvConfig, count: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """[count, STEPS, joints] angles and velocities of demonstrations."""
    recorded = record_demonstrations(case.build_arms().expert, count, seed=seed, horizon=STEPS)
    return recorded.qpos[:, 1:].astype(np.float32), recorded.qvel[:, 1:].astype(np.float32)


def bound_function(case: EnvConfig, **options: Any) -> Any:
    """A function of such angles and velocities to the kinematic bound, [count, STEPS]."""
    arms = case.build_arms().embodiments
    options |= case.metric.build(*arms).arguments
    return jax.jit(jax.vmap(lambda qpos, qvel: mimic.kinematic_bound(*arms, qpos, qvel, **options)))


def adam_reference(case: EnvConfig, qpos: np.ndarray, qvel: np.ndarray) -> np.ndarray:
    """[steps] minimum distance by Adam from many random poses, for [steps, joints] angles and velocities."""
    expert, learner = case.build_arms().embodiments
    metric = case.metric.build(expert, learner)
    limits = pose_limits(learner, qpos.dtype)
    lower, upper = np.asarray(learner.joint_range).T
    poses = np.random.default_rng(11).uniform(lower, upper, (len(qpos), STARTS, learner.num_joints))

    def solve(qpos: jax.Array, qvel: jax.Array, poses: jax.Array) -> jax.Array:
        states = mimic.link_states(expert, qpos, qvel)
        speed = jnp.maximum(jnp.abs(qvel).max(), MINIMUM_SPEED)  # unit of the learner's velocities

        def distance(motion: Any) -> jax.Array:
            return metric(states, mimic.link_states(learner, motion[0], speed * motion[1]))

        def descend(start: Any, step_size: float, count: int) -> Any:
            optimiser = optax.adam(optax.cosine_decay_schedule(step_size, count))

            def iterate(carry: Any, _: None) -> tuple[Any, None]:
                motion, state, best, minimum = carry
                value, gradient = jax.value_and_grad(distance)(motion)
                best = jax.tree.map(lambda new, old: jnp.where(value < minimum, new, old), motion, best)
                updates, state = optimiser.update(gradient, state)
                moved: Any = optax.apply_updates(motion, updates)
                return ((jnp.clip(moved[0], *limits), moved[1]), state, best, jnp.minimum(value, minimum)), None

            first = start, optimiser.init(start), start, jnp.asarray(jnp.inf, qpos.dtype)
            return jax.lax.scan(iterate, first, None, length=count)[0][2:]

        own_qpos, own_qvel = (shared_joints(expert, learner, x) for x in (qpos, qvel / speed))
        guesses = jnp.concatenate([own_qpos[None], poses])
        starts = guesses, jnp.broadcast_to(own_qvel, guesses.shape)
        ends, minima = jax.vmap(lambda *start: descend(start, STEP_SIZES[0], ITERATIONS))(*starts)
        kept = (x[jax.lax.top_k(-minima, KEPT)[1]] for x in ends)
        return jax.vmap(lambda *start: descend(start, STEP_SIZES[1], REFINEMENT)[1])(*kept).min()

    return np.asarray(jax.jit(jax.vmap(solve))(qpos, qvel, poses.astype(qpos.dtype)))


def missed(bound: np.ndarray, reference: np.ndarray) -> Row:
    excess = bound - reference
    counts = {"missed_absolute": excess > ABSOLUTE, "missed_relative": excess > RELATIVE * reference + ROUNDING}
    sizes = {"largest_excess": float(excess.max()), "mean_excess": float(excess.mean())}
    return {name: int(np.sum(is_missed)) for name, is_missed in counts.items()} | sizes


def run_case(name: str, seeds: Sequence[int]) -> Row:
    """The bound against the reference, on the demonstrations of some seeds."""
    case, count = CASES[name], 6 if name.startswith("planar") else 4
    qpos, qvel = (np.concatenate(x) for x in zip(*(motions(case, count, seed) for seed in seeds), strict=True))
    bound, more = (np.ravel(bound_function(case, **options)(qpos, qvel)) for options in ({}, MORE))
    adam = adam_reference(case, *(x.reshape(-1, x.shape[-1]) for x in (qpos, qvel)))
    reference = np.minimum(np.minimum(bound, more), adam)
    row = {"case": name, "seeds": list(seeds), "steps": len(bound), "mean_reference": float(reference.mean())}
    searches = {"adam": missed(adam, reference), "more": missed(more, reference)}
    return {**row, **missed(bound, reference), "searches": searches}


def main() -> None:
    options = make_parser("bound", __doc__, case=CASES, seeds=[0, 1, 2]).parse_args()
    rows = []
    for name in options.case:
        rows.append(run_case(name, options.seeds))
        total = {key: sum(row[key] for row in rows) for key in COUNTS}
        write_results(options, total=total, results=rows)
    print_table(rows, COLUMNS)


if __name__ == "__main__":
    main()
