"""How often the kinematic bound misses the global minimum, and what it costs.

    python -m benchmarks.bound --out FILE [--case NAME] [--seeds 0 1 2]

The reference of a step is the least distance that anything found: the bound itself, a search of other design (Adam from
64 random poses other at each step, and from the expert's own angles, 200 iterations; the best four refined by 300
more), and `closest_motion` with more starts, more iterations and another seed. A step is missed where the bound is
above its reference by more than 1e-3 chain lengths or radians (the metric's own unit), or by more than 0.1 % and 1e-5.
The demonstrations are `pd`, 50 steps each. "paper" is the paper's metric with merged links, "default" is that of
`MetricConfig`, "hard" has hard correspondence and adaptive weights. The cost is that of 156 demonstrations at the
default metric, as at the start of a training, in seconds of wall time and of all cores together.
"""

import argparse
import dataclasses
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax
from rich.console import Console
from rich.table import Table

import mimic
from benchmarks.pose import planar
from benchmarks.record import write_results
from mimic.arms.arm import Arm, ArmConfig, build_arm
from mimic.envs.recording import record_demonstrations
from mimic.metric.config import MetricConfig
from mimic.retargeting.pose import pose_limits, shared_joints

STEPS = 50
ABSOLUTE, RELATIVE, ROUNDING = 1e-3, 1e-3, 1e-5
STARTS, ITERATIONS, KEPT, REFINEMENT = 64, 200, 4, 300  # of the reference
STEP_SIZES = 0.1, 0.02  # [rad, and times the expert's speed]
LEAST_SPEED = 1e-2  # rad/s
MORE: dict[str, int] = {"starts": 16, "iterations": 40, "seed": 1}
COST_DEMONSTRATIONS = 156

DEFAULT = MetricConfig()
PAPER = MetricConfig(links="merged", correspondence="overlap", translation=0.0)


@dataclasses.dataclass(frozen=True)
class Case:
    """A learner, what it imitates, and the metric."""

    expert: ArmConfig
    learner: ArmConfig
    metric: MetricConfig
    demonstrations: int = 4


def _cases() -> dict[str, Case]:
    panda, four, three = ArmConfig(), ArmConfig(locked=[3, 6, 7]), ArmConfig(locked=[2, 3, 6, 7])
    cases = {}
    for name, metric in (("paper", PAPER), ("default", DEFAULT)):
        hard = dataclasses.replace(metric, correspondence="hard", adaptive=True)
        cases[f"joint 5 locked, {name}"] = Case(panda, ArmConfig(locked=[5]), metric)
        cases[f"joint 1 locked, {name}"] = Case(panda, ArmConfig(locked=[1]), metric)
        cases[f"planar 7->4, {name}"] = Case(planar(7), planar(4), metric, 6)
        cases[f"panda4dof hard, {name}"] = Case(panda, four, hard)
    cases["panda4dof, default"] = Case(panda, four, DEFAULT)
    cases["panda3dof, default"] = Case(panda, three, DEFAULT)
    return cases


CASES = _cases()
COST_CASE = "panda4dof, default"


class Problem:
    """The arms of a case with their metric."""

    def __init__(self, case: Case):
        self.recorded: Arm = build_arm(case.expert)
        self.expert = self.recorded.embodiment
        self.learner = build_arm(case.learner, links=case.metric.links).embodiment
        self.correspondence = case.metric.make_correspondence(self.expert, self.learner)
        self.weights = case.metric.make_weights()

    def motions(self, count: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
        """[count, STEPS, joints] angles and velocities of demonstrations."""
        recorded = record_demonstrations(self.recorded, count, seed=seed, horizon=STEPS)
        return recorded.qpos[:, 1:].astype(np.float32), recorded.qvel[:, 1:].astype(np.float32)

    def bound(self, qpos: Any, qvel: Any, **options: int) -> jax.Array:
        """[count, STEPS] kinematic bound."""

        def one(qpos: jax.Array, qvel: jax.Array) -> jax.Array:
            metric = self.correspondence, self.weights
            return mimic.kinematic_bound(self.expert, self.learner, qpos, qvel, *metric, **options)  # type: ignore[arg-type]

        return jax.vmap(one)(qpos, qvel)

    def distance(self, states: Any, motion: Any, speed: Any) -> jax.Array:
        """Of the expert's link states and the learner's angles and velocities, these in units of a speed."""
        learner_states = mimic.link_states(self.learner, motion[0], speed * motion[1])
        return mimic.embodiment_distance(states, learner_states, self.correspondence, self.weights)


def adam_reference(problem: Problem, qpos: np.ndarray, qvel: np.ndarray) -> np.ndarray:
    """[steps] least distance that Adam finds from many random poses, of [steps, joints] angles and velocities."""
    learner = problem.learner
    limits = pose_limits(learner, qpos.dtype)
    lower, upper = np.asarray(learner.joint_range).T
    poses = np.random.default_rng(11).uniform(lower, upper, (len(qpos), STARTS, learner.num_joints))

    def descend(states: Any, start: Any, speed: Any, step_size: float, count: int) -> Any:
        optimiser = optax.adam(optax.cosine_decay_schedule(step_size, count))

        def iterate(carry: Any, _: None) -> tuple[Any, None]:
            motion, state, best, least = carry
            value, gradient = jax.value_and_grad(lambda motion: problem.distance(states, motion, speed))(motion)
            best = jax.tree.map(lambda new, old: jnp.where(value < least, new, old), motion, best)
            updates, state = optimiser.update(gradient, state)
            moved: Any = optax.apply_updates(motion, updates)
            return ((jnp.clip(moved[0], *limits), moved[1]), state, best, jnp.minimum(value, least)), None

        first = start, optimiser.init(start), start, jnp.asarray(jnp.inf, qpos.dtype)
        return jax.lax.scan(iterate, first, None, length=count)[0][2:]

    def solve(qpos: jax.Array, qvel: jax.Array, poses: jax.Array) -> jax.Array:
        states = mimic.link_states(problem.expert, qpos, qvel)
        speed = jnp.maximum(jnp.abs(qvel).max(), LEAST_SPEED)
        own_qpos, own_qvel = (shared_joints(problem.expert, learner, x) for x in (qpos, qvel / speed))
        guesses = jnp.concatenate([own_qpos[None], poses])
        starts = guesses, jnp.broadcast_to(own_qvel, guesses.shape)
        ends, least = jax.vmap(lambda *start: descend(states, start, speed, STEP_SIZES[0], ITERATIONS))(*starts)
        nearest = jax.lax.top_k(-least, KEPT)[1]
        kept = (x[nearest] for x in ends)
        return jax.vmap(lambda *start: descend(states, start, speed, STEP_SIZES[1], REFINEMENT)[1])(*kept).min()

    return np.asarray(jax.jit(jax.vmap(solve))(qpos, qvel, poses.astype(qpos.dtype)))


def missed(bound: np.ndarray, reference: np.ndarray) -> dict[str, Any]:
    """How many steps are above the reference, and by how much."""
    excess = bound - reference
    return {
        "missed_absolute": int(np.sum(excess > ABSOLUTE)),
        "missed_relative": int(np.sum(excess > RELATIVE * reference + ROUNDING)),
        "largest_excess": float(excess.max()),
        "mean_excess": float(excess.mean()),
    }


def run_case(name: str, seeds: Sequence[int]) -> dict[str, Any]:
    """The bound against the reference, on the demonstrations of some seeds."""
    problem, count = Problem(CASES[name]), CASES[name].demonstrations
    motions = [np.concatenate(x) for x in zip(*(problem.motions(count, seed) for seed in seeds), strict=True)]
    bound = np.ravel(jax.jit(problem.bound)(*motions))
    more = np.ravel(jax.jit(lambda *motions: problem.bound(*motions, **MORE))(*motions))
    adam = adam_reference(problem, *(x.reshape(-1, x.shape[-1]) for x in motions))
    reference = np.minimum(np.minimum(bound, more), adam)
    return {
        "case": name,
        "seeds": list(seeds),
        "steps": len(bound),
        "mean_reference": float(reference.mean()),
        **missed(bound, reference),
        "searches": {"adam": missed(adam, reference), "more": missed(more, reference)},
    }


def measure_cost() -> dict[str, float]:
    """Of what a training computes at its start."""
    problem = Problem(CASES[COST_CASE])
    motions = problem.motions(COST_DEMONSTRATIONS, 0)
    clocks = [(time.perf_counter(), time.process_time())]
    program = jax.jit(problem.bound).lower(*motions).compile()
    clocks.append((time.perf_counter(), time.process_time()))
    jax.block_until_ready(program(*motions))
    clocks.append((time.perf_counter(), time.process_time()))
    spans = {}
    for what, before, after in (("compile", *clocks[:2]), ("run", *clocks[1:])):
        spans |= {f"{what}_s": round(after[0] - before[0], 2), f"{what}_cpu_s": round(after[1] - before[1], 2)}
    return {"demonstrations": COST_DEMONSTRATIONS, "steps": COST_DEMONSTRATIONS * STEPS, **spans}


def main() -> None:
    """Runs all cases, and writes the file after each."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.bound", description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--out", type=Path, help="file of results; printed only where none is given")
    parser.add_argument("--case", choices=CASES, action="append", help="only this one (may be repeated)")
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2], help="of the demonstrations")
    parser.add_argument("--commit", help="what the results are of, where this is no git checkout")
    options = parser.parse_args()
    table = Table("case", "steps", "missed (1e-3)", "missed (0.1 %)", "largest excess", "reference")
    cost, results = measure_cost(), []
    for name in options.case or CASES:
        result = run_case(name, options.seeds)
        results.append(result)
        keys = "steps", "missed_absolute", "missed_relative"
        counts = (str(result[key]) for key in keys)
        table.add_row(name, *counts, f"{result['largest_excess']:.1e}", f"{result['mean_reference']:.4f}")
        if options.out:
            total = {key: sum(result[key] for result in results) for key in keys}
            write_results(options.out, "bound", options.commit, cost=cost, total=total, results=results)
    Console(width=120).print(table)  # also where there is no terminal
    Console(width=120).print(cost)


if __name__ == "__main__":
    main()
