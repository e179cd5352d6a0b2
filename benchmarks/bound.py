"""Steps at which the kinematic bound misses the global minimum, by how much, and its cost.

    python -m benchmarks.bound --out FILE [--case NAME] [--seeds 0 1 2]

The reference of a step is the minimum of three searches: the bound itself, Adam from 64 random poses and from the
expert's own angles (200 iterations; the best four refined by 300 more), and `closest_motion` with more starts, more
iterations and another seed. A step is missed where the bound is above its reference by more than 1e-3 chain lengths or
radians (the metric's own unit), or by more than 0.1 % and 1e-5. "paper" is the paper's metric with merged links, "hard"
has hard correspondence and adaptive weights. The cost is that of 156 demonstrations, as at the start of a training, in
seconds of wall time and of all cores together.
"""

import dataclasses
import time
from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax

import mimic
from benchmarks.common.parser import make_parser
from benchmarks.common.record import Row, print_table, write_results
from benchmarks.pose import planar
from mimic.arms.arm import ArmConfig, build_arm
from mimic.envs.recording import record_demonstrations
from mimic.metric.config import MetricConfig
from mimic.retargeting.pose import pose_limits, shared_joints

STEPS = 50
ABSOLUTE, RELATIVE, ROUNDING = 1e-3, 1e-3, 1e-5
STARTS, ITERATIONS, KEPT, REFINEMENT = 64, 200, 4, 300  # of the reference
STEP_SIZES = 0.1, 0.02  # [rad], and for velocities in units of the expert's
MINIMUM_SPEED = 1e-2  # rad/s
MORE: dict[str, Any] = {"starts": 16, "iterations": 40, "seed": 1}
COST_CASE, COST_DEMONSTRATIONS = "panda4dof, default", 156
COUNTS = "steps", "missed_absolute", "missed_relative"
COLUMNS = "case steps missed_absolute missed_relative largest_excess:.1e mean_reference:.4f"


class Case(NamedTuple):
    """Two arms and the metric between them."""

    expert: ArmConfig
    learner: ArmConfig
    metric: MetricConfig
    demonstrations: int = 4


def _cases() -> dict[str, Case]:
    panda, four, three = ArmConfig(), ArmConfig(locked=[3, 6, 7]), ArmConfig(locked=[2, 3, 6, 7])
    default, cases = MetricConfig(), {}
    paper = MetricConfig(links="merged", correspondence="overlap", translation=0.0)
    for name, metric in (("paper", paper), ("default", default)):
        hard = dataclasses.replace(metric, correspondence="hard", adaptive=True)
        cases[f"joint 5 locked, {name}"] = Case(panda, ArmConfig(locked=[5]), metric)
        cases[f"joint 1 locked, {name}"] = Case(panda, ArmConfig(locked=[1]), metric)
        cases[f"planar 7->4, {name}"] = Case(planar(7), planar(4), metric, 6)
        cases[f"panda4dof hard, {name}"] = Case(panda, four, hard)
    return cases | {"panda4dof, default": Case(panda, four, default), "panda3dof, default": Case(panda, three, default)}


CASES = _cases()


class Problem:
    def __init__(self, case: Case):
        self.recorded, learner = build_arm(case.expert), build_arm(case.learner, links=case.metric.links)
        self.expert, self.learner = self.recorded.embodiment, learner.embodiment
        self.metric = case.metric.build(self.expert, self.learner)

    def motions(self, count: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
        """[count, STEPS, joints] angles and velocities of demonstrations."""
        recorded = record_demonstrations(self.recorded, count, seed=seed, horizon=STEPS)
        return recorded.qpos[:, 1:].astype(np.float32), recorded.qvel[:, 1:].astype(np.float32)

    def bound(self, qpos: Any, qvel: Any, **options: Any) -> jax.Array:
        arms, options = (self.expert, self.learner), {**self.metric.arguments, **options}
        return jax.vmap(lambda qpos, qvel: mimic.kinematic_bound(*arms, qpos, qvel, **options))(qpos, qvel)


def adam_reference(problem: Problem, qpos: np.ndarray, qvel: np.ndarray) -> np.ndarray:
    """[steps] minimum distance by Adam from many random poses, for [steps, joints] angles and velocities."""
    learner = problem.learner
    limits = pose_limits(learner, qpos.dtype)
    lower, upper = np.asarray(learner.joint_range).T
    poses = np.random.default_rng(11).uniform(lower, upper, (len(qpos), STARTS, learner.num_joints))

    def solve(qpos: jax.Array, qvel: jax.Array, poses: jax.Array) -> jax.Array:
        states = mimic.link_states(problem.expert, qpos, qvel)
        speed = jnp.maximum(jnp.abs(qvel).max(), MINIMUM_SPEED)  # unit of the learner's velocities

        def distance(motion: Any) -> jax.Array:
            return problem.metric(states, mimic.link_states(learner, motion[0], speed * motion[1]))

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

        own_qpos, own_qvel = (shared_joints(problem.expert, learner, x) for x in (qpos, qvel / speed))
        guesses = jnp.concatenate([own_qpos[None], poses])
        starts = guesses, jnp.broadcast_to(own_qvel, guesses.shape)
        ends, minima = jax.vmap(lambda *start: descend(start, STEP_SIZES[0], ITERATIONS))(*starts)
        kept = (x[jax.lax.top_k(-minima, KEPT)[1]] for x in ends)
        return jax.vmap(lambda *start: descend(start, STEP_SIZES[1], REFINEMENT)[1])(*kept).min()

    return np.asarray(jax.jit(jax.vmap(solve))(qpos, qvel, poses.astype(qpos.dtype)))


def missed(bound: np.ndarray, reference: np.ndarray) -> Row:
    excess = bound - reference
    absolute, relative = excess > ABSOLUTE, excess > RELATIVE * reference + ROUNDING
    counts = {"missed_absolute": int(absolute.sum()), "missed_relative": int(relative.sum())}
    return {**counts, "largest_excess": float(excess.max()), "mean_excess": float(excess.mean())}


def run_case(name: str, seeds: Sequence[int]) -> Row:
    """The bound against the reference, on the demonstrations of some seeds."""
    problem, count = Problem(CASES[name]), CASES[name].demonstrations
    motions = [np.concatenate(x) for x in zip(*(problem.motions(count, seed) for seed in seeds), strict=True)]
    bound = np.ravel(jax.jit(problem.bound)(*motions))
    more = np.ravel(jax.jit(lambda *motions: problem.bound(*motions, **MORE))(*motions))
    adam = adam_reference(problem, *(x.reshape(-1, x.shape[-1]) for x in motions))
    reference = np.minimum(np.minimum(bound, more), adam)
    row = {"case": name, "seeds": list(seeds), "steps": len(bound), "mean_reference": float(reference.mean())}
    searches = {"adam": missed(adam, reference), "more": missed(more, reference)}
    return {**row, **missed(bound, reference), "searches": searches}


def measure_cost() -> Row:
    """Cost of the bound at the start of a training."""
    problem = Problem(CASES[COST_CASE])
    motions = problem.motions(COST_DEMONSTRATIONS, 0)
    clocks = [(time.perf_counter(), time.process_time())]
    program = jax.jit(problem.bound).lower(*motions).compile()
    clocks.append((time.perf_counter(), time.process_time()))
    jax.block_until_ready(program(*motions))
    clocks.append((time.perf_counter(), time.process_time()))
    seconds = np.diff(clocks, axis=0).round(2).ravel().tolist()
    costs = dict(zip(("compile_s", "compile_cpu_s", "run_s", "run_cpu_s"), seconds, strict=True))
    return {"demonstrations": COST_DEMONSTRATIONS, "steps": COST_DEMONSTRATIONS * STEPS, **costs}


def main() -> None:
    options = make_parser("bound", __doc__, case=CASES, seeds=[0, 1, 2]).parse_args()
    cost, rows = measure_cost(), []
    for name in options.case:
        rows.append(run_case(name, options.seeds))
        total = {key: sum(row[key] for row in rows) for key in COUNTS}
        write_results(options, cost=cost, total=total, results=rows)
    print_table(rows, COLUMNS)
    print(cost)


if __name__ == "__main__":
    main()
