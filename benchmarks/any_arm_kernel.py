"""The physics of any arm on a GPU: compile time and physics steps per second of forms of the kernel.

    python -m benchmarks.any_arm_kernel [--out FILE] [--variants loops composite ...] [--arms 65536 524288]

A physics step is one of Runge-Kutta with four evaluations of the dynamics, and a call of `--substeps` steps is one
dispatch. Each sample has an arm of its own: random arms, of which `DRAWN` are drawn and repeated. `largest_error` is
that of the joint velocities of these arms after a call, against double precision, relative to 1 rad/s plus the arm's
largest velocity.
"""

from collections.abc import Callable, Iterator
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks.common.parser import make_parser
from benchmarks.common.record import Row, collect, failure
from benchmarks.common.timing import time_program
from mimic.any_arm import articulated_kernel, dynamics
from mimic.any_arm.arrays import MAX_JOINTS
from mimic.any_arm.composite_kernel import LAUNCH, Form, gpu_kernel
from mimic.any_arm.physics import make_advance
from mimic.any_arm.sampler import random_arm
from mimic.envs.physics import Load
from mimic.metric.fused_kernel import LaunchConfig

TIMESTEP = 0.01  # s
DRAWN = 512
COLUMNS = "variant arms compile_s:.1f steps_per_s:.3g spread:.1% largest_error:.1e"
Kernel = Callable[..., tuple[jax.Array, ...]]


def _composite(launch: LaunchConfig = LAUNCH, **form: Any) -> Callable[[int], Kernel]:
    return lambda substeps: gpu_kernel(TIMESTEP, substeps, launch=launch, form=Form(**form))


# The last one compiles for long.
VARIANTS: dict[str, Callable[[int], Kernel]] = {
    "composite": _composite(),
    "loops": lambda substeps: articulated_kernel.gpu_kernel(TIMESTEP, substeps),
    "registers_128": _composite(LaunchConfig(512, 16, 1)),
    "two_samples": _composite(LaunchConfig(128, 2, 1)),
    "rows_first": _composite(LaunchConfig(64, 2, 0)),
    "block_32": _composite(LaunchConfig(32, 1, 1)),
    "block_128": _composite(LaunchConfig(128, 4, 1)),
    "block_256": _composite(LaunchConfig(256, 8, 1)),
    "barriers": _composite(LaunchConfig(256, 8, 1), has_barriers=True),
    "late_elimination": _composite(is_interleaved=False),
    "reciprocal": _composite(reciprocal="hardware"),
    "hardware": _composite(sines="hardware", reciprocal="hardware"),
    "exact_sines": _composite(sines="exact"),
    "direct_loads": _composite(rows_in_loops=False),
}


def random_inputs(count: int) -> list[np.ndarray]:
    """The arguments of a kernel for the first arms: numbers, qpos, qvel, torque and load, each [count, width]."""
    rng = np.random.default_rng(0)
    with jax.default_device(jax.devices("cpu")[0]):
        arms = jax.jit(jax.vmap(random_arm))(jax.random.split(jax.random.PRNGKey(0), count))
        numbers = np.asarray(jax.vmap(dynamics.joint_numbers)(arms), np.float32)
    is_free = np.asarray(arms.is_free)
    qpos, qvel, torque = rng.uniform(-1, 1, (3, count, MAX_JOINTS)) * np.array([3.0, 1.0, 1.0])[:, None, None]
    load = rng.uniform(0.8, 1.2, (count, 2))
    return [numbers, *(x.astype(np.float32) for x in (qpos, qvel * is_free, torque, load))]


def reference(inputs: list[np.ndarray], substeps: int) -> np.ndarray:
    """Velocities after a call in double precision, by the equations for CPUs."""
    with jax.enable_x64(True), jax.default_device(jax.devices("cpu")[0]):
        arms = _numbers_as_arms(inputs[0].astype(float))
        states = (x.astype(float) for x in inputs[1:4])
        load = Load(*inputs[4].astype(float).T)
        return np.asarray(jax.jit(jax.vmap(make_advance(TIMESTEP, substeps)))(arms, *states, load)[1])


def _numbers_as_arms(numbers: np.ndarray) -> Any:
    """Arms with these numbers, see `dynamics.joint_numbers`; what has no effect on the dynamics is 0."""
    arms = jax.eval_shape(jax.vmap(random_arm), jax.random.split(jax.random.PRNGKey(0), len(numbers)))
    arms = jax.tree.map(lambda x: np.zeros(x.shape), arms)
    joints = dynamics.joint_of(np.moveaxis(numbers.reshape(len(numbers), MAX_JOINTS, -1), -1, 0))
    return arms.replace(
        twist=np.stack(joints.twist, -1),
        offset=np.stack(joints.offset, -1),
        reference=joints.reference,
        first_moment=np.stack(joints.first, -1),
        second_moment=np.stack(joints.second, -1),
        armature=joints.armature - (1 - joints.is_free),
        damping=joints.damping,
        is_free=joints.is_free,
    )


def run(kernel: Kernel, inputs: list[jax.Array], expected: np.ndarray, substeps: int) -> Row:
    """Measures a kernel."""
    timing = time_program(kernel, *inputs)
    actual = np.asarray(timing.result[1][: len(expected)], float)
    expected = expected[: len(actual)]
    errors = np.abs(actual - expected).max(axis=1) / (1 + np.abs(expected).max(axis=1))
    steps_per_s = len(inputs[0]) * substeps / timing.median
    return {**timing.summary(), "steps_per_s": steps_per_s, "largest_error": float(errors.max())}


def rows(variants: list[str], counts: list[int], substeps: int) -> Iterator[Row]:
    """Measures variants one after the other, first all of them for the first number of arms."""
    drawn = random_inputs(DRAWN)
    expected = reference(drawn, substeps)
    for arms in counts:
        inputs = [jnp.asarray(np.resize(x, (arms, x.shape[1]))) for x in drawn]
        for name in variants:
            row: Row = {"variant": name, "arms": arms}
            try:
                row |= run(VARIANTS[name](substeps), inputs, expected, substeps)
            except Exception as error:  # of compilers
                row |= failure(error)
            print(row, flush=True)
            yield row


def main() -> None:
    """Runs the benchmark."""
    options = make_parser(
        "any_arm_kernel", __doc__, variants=VARIANTS, arms=[65_536, 524_288], substeps=10
    ).parse_args()
    note = "physics steps of RK4; each arm has its own numbers; a call is a dispatch"
    measured = rows(options.variants, options.arms, options.substeps)
    collect(options, measured, "results", COLUMNS, note=note, timestep=TIMESTEP, substeps=options.substeps)


if __name__ == "__main__":
    main()
