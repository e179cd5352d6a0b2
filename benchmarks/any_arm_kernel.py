"""The kernels that simulate any arm, on a GPU: compile time, steps per second, and error.

    python -m benchmarks.any_arm_kernel [--out FILE] [--kernels physics panda7dof panda4dof] [--arms 65536 524288]

`physics`: Runge-Kutta steps of random arms, each with numbers of its own. A step has four evaluations of the dynamics,
and a call of `--substeps` steps is one dispatch. The others are the inner loop of an environment with world=hardware,
each arm with an episode of its own. A step is 1 ms with one period of the controller and one evaluation, and a call is
a tick of `--periods` ms.

`DRAWN` samples are drawn and repeated. `largest_error` is that of their joint velocities after a call, against the
equations for CPUs in double precision, relative to 1 rad/s plus the arm's largest velocity. `array_error` is that of
the equations for CPUs in single precision.
"""

from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks.common.parser import make_parser
from benchmarks.common.record import Row, collect, failure
from benchmarks.common.timing import time_program
from mimic.arms.arm import build_arm
from mimic.arms.arrays import MAX_JOINTS
from mimic.arms.sampler import random_arm
from mimic.control.joint_control import JointParameters, Reference, action_target
from mimic.envs import env_config
from mimic.envs.world_env import plant_of
from mimic.physics import composite_kernel, inner_loop
from mimic.physics.joint_numbers import joint_numbers
from mimic.physics.plant import draw_episode
from mimic.physics.world import WorldConfig

TIMESTEP = 0.01  # s, of the physics
DRAWN = 512
COLUMNS = "kernel arms compile_s:.1f steps_per_s:.3g calls_per_s:.3g spread:.1% largest_error:.1e array_error:.1e"
Outputs = tuple[Any, ...]


class Case(NamedTuple):
    """A kernel with its arguments.

    Attributes:
      kernel: takes and returns arrays [samples, width].
      arrays: the same equations on arrays [width, samples].
      inputs: arguments of the kernel for the drawn samples.
      velocities: joint velocities in the kernel's results [samples, joints].
      steps: in a call.
    """

    kernel: Callable[..., Outputs]
    arrays: Callable[..., Outputs]
    inputs: list[np.ndarray]
    velocities: Callable[[Outputs], Any]
    steps: int


def of_physics(substeps: int) -> Case:
    """Random arms in random motion, under random torques and loads."""
    rng = np.random.default_rng(0)
    arms = jax.jit(jax.vmap(random_arm))(jax.random.split(jax.random.PRNGKey(0), DRAWN))
    qpos, qvel, torque = rng.uniform(-1, 1, (3, DRAWN, MAX_JOINTS)) * np.array([3.0, 1.0, 1.0])[:, None, None]
    load = rng.uniform(0.8, 1.2, (DRAWN, 2))
    inputs = [jax.vmap(joint_numbers)(arms), qpos, qvel * np.asarray(arms.is_free), torque, load]
    return Case(
        composite_kernel.gpu_kernel(TIMESTEP, substeps),
        composite_kernel.array_step(TIMESTEP, substeps),
        [np.asarray(x, np.float32) for x in inputs],
        lambda outputs: outputs[1],
        substeps,
    )


def of_inner_loop(name: str, periods: int) -> Case:
    """Random episodes of an environment near its start pose, with random targets."""
    config, rng = env_config(name, world="hardware"), np.random.default_rng(0)
    arm = build_arm(config.learner, config.limits)
    plant, home = (
        plant_of(config, arm),
        np.asarray(arm.embodiment.home),
    )

    def draw(key: jax.Array) -> inner_loop.Episode:
        return plant.episode(draw_episode(config.world or WorldConfig(), config.randomization, len(home), key))

    episodes = jax.jit(jax.vmap(draw))(jax.random.split(jax.random.PRNGKey(0), DRAWN))
    qpos, qvel, qacc, torque, action = rng.uniform(-1, 1, (5, DRAWN, len(home)))
    reference = Reference(home + 0.1 * qpos, 0.1 * qvel, 0.1 * qacc)
    state = inner_loop.LoopState(reference.qpos, reference.qvel, reference, torque)
    parameters = JointParameters(*map(jnp.asarray, plant.constants.parameters))

    def aim(action: jax.Array, reference: Reference) -> jax.Array:
        return action_target(config.control, action, reference, parameters, jnp)

    state, target = jax.tree.map(jnp.asarray, (state, jax.vmap(aim)(action, reference)))
    inputs = jax.vmap(inner_loop.flattened)(episodes, state, target)
    arguments = config.control, plant.constants, periods
    return Case(
        inner_loop.gpu_kernel(*arguments),
        inner_loop.array_loop(*arguments),
        [np.asarray(x, np.float32) for x in inputs],
        lambda outputs: outputs[0].reshape(len(outputs[0]), len(home), -1)[:, :, 1],
        periods,
    )


def on_arrays(case: Case, dtype: Any) -> np.ndarray:
    """Velocities of the drawn samples by the equations for CPUs."""
    with jax.enable_x64(dtype == np.float64):
        outputs = jax.jit(case.arrays)(*(jnp.asarray(x.T, dtype) for x in case.inputs))
        return np.asarray(case.velocities(tuple(x.T for x in outputs)), float)


def largest_error(actual: np.ndarray, expected: np.ndarray) -> float:
    """Relative to 1 rad/s plus the largest velocity of each arm."""
    return float((np.abs(actual - expected).max(axis=1) / (1 + np.abs(expected).max(axis=1))).max())


def measure(case: Case, arms: int, expected: np.ndarray) -> Row:
    """The row of a kernel."""
    count = min(arms, DRAWN)
    timing = time_program(case.kernel, *(jnp.asarray(np.resize(x, (arms, x.shape[1]))) for x in case.inputs))
    actual = np.asarray(case.velocities(timing.result)[:count], float)
    rates = {"steps_per_s": arms * case.steps / timing.median, "calls_per_s": arms / timing.median}
    return {**timing.summary(), **rates, "largest_error": largest_error(actual, expected[:count])}


def rows(kernels: list[str], counts: list[int], substeps: int, periods: int) -> Iterator[Row]:
    """Measures the kernels one after the other."""
    for name in kernels:
        with jax.default_device(jax.devices("cpu")[0]):
            case = of_physics(substeps) if name == "physics" else of_inner_loop(name, periods)
            expected = on_arrays(case, np.float64)
            array_error = largest_error(on_arrays(case, np.float32), expected)
        for arms in counts:
            row: Row = {"kernel": name, "arms": arms, "array_error": array_error}
            try:
                row |= measure(case, arms, expected)
            except Exception as error:  # of compilers
                row |= failure(error)
            print(row, flush=True)
            yield row


def main() -> None:
    """Runs the benchmark."""
    options = make_parser(
        "any_arm_kernel",
        __doc__,
        kernels=("physics", "panda7dof", "panda4dof"),
        arms=[65_536, 524_288],
        substeps=10,
        periods=50,
    ).parse_args()
    measured = rows(options.kernels, options.arms, options.substeps, options.periods)
    settings = {"timestep": TIMESTEP, "substeps": options.substeps, "periods": options.periods}
    collect(options, measured, "results", COLUMNS, **settings)


if __name__ == "__main__":
    main()
