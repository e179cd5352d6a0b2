"""The metric's kernel: from joint motions of two arms to their embodiment distance and its gradient.

    python -m benchmarks.kernel [--out FILE] [--batches 1e2 ... 1e8] [--links 3 ... 64] [--methods mimic ...]

All methods compute the same: forward kinematics with velocities, link distances in the default metric with a static
correspondence, and their mean. "gradient" is the value with the gradient with respect to the learner's qpos and qvel,
"all" with respect to those of both arms. The pairs of poses are random, on the device. Batches are of the Panda with 7
joints and the one with 4; links are those of both of two planar arms. `mimic` is `motion_distance`, `composition` its
parts called separately, `matrices` a straightforward JAX program on 4x4 matrices, `torch` the same in PyTorch, where it
is installed. A case that does not fit into memory, or follows one above LONGEST seconds a call, has no numbers. Limits
of the device, from the same run: memory traffic of a copy, and the rate of fused multiply-adds.
"""

import dataclasses
import functools
import itertools
import os
from collections.abc import Callable, Iterator, Sequence
from typing import Any, cast

import jax
import jax.numpy as jnp
import numpy as np

import mimic
from benchmarks.common.parser import BenchmarkParser
from benchmarks.common.record import Results, Row, failure, print_table
from benchmarks.common.timing import Timing, time_call, time_program
from benchmarks.figures.kernel_figure import plot
from benchmarks.peers import kernel_peers
from mimic.metric.config import MetricConfig

BATCHES = (1e2, 1e3, 1e4, 1e5, 1e6, 1e7, 1e8)
LINKS = (3, 4, 7, 16, 32, 64)
METHODS = ("torch", "torch.compile", "mimic", "composition", "matrices")  # PyTorch first: JAX keeps its memory
QUANTITIES = {"value": (), "gradient": (2, 3), "all": (0, 1, 2, 3)}  # arguments of the gradient
METRIC = MetricConfig()
WEIGHTS = cast(mimic.DistanceWeights, METRIC.make_weights())  # constants, in the default metric
LONGEST = 1.0  # s a call; the next case is about ten times as large
CHECKED = 1000  # pairs that are compared with double precision
TWO_TO = {"copy": 26, "multiply_add": 22}  # length of the arrays that measure the limits


@dataclasses.dataclass(frozen=True, eq=False)  # compared by identity, as the key of a cache
class Arms:
    expert: mimic.Embodiment
    learner: mimic.Embodiment


def panda_pair() -> Arms:
    return Arms(mimic.panda(), mimic.panda(locked=(3, 6, 7)))


def planar_pair(links: int) -> Arms:
    """Two arms of different proportions."""
    rng = np.random.default_rng(links)
    return Arms(*(mimic.planar_arm(rng.uniform(0.5, 1.5, links) / links) for _ in range(2)))


def jax_distance(method: str, arms: Arms) -> Callable[..., Any]:
    """The distance of one sample by a method in JAX."""
    correspondence = METRIC.make_correspondence(arms.expert, arms.learner)
    if method == "mimic":
        return mimic.motion_distance(arms.expert, arms.learner, correspondence, WEIGHTS)
    if method == "matrices":
        return kernel_peers.jax_distance(arms.expert, arms.learner, np.asarray(correspondence), WEIGHTS)

    def composition(*motion: jax.Array) -> jax.Array:
        states = mimic.link_states(arms.expert, *motion[:2]), mimic.link_states(arms.learner, *motion[2:])
        return mimic.embodiment_distance(*states, correspondence, WEIGHTS)

    return composition


def batched(distance: Callable[..., Any], quantity: str) -> Callable[..., Any]:
    by = QUANTITIES[quantity]
    return jax.vmap(jax.value_and_grad(distance, by) if by else distance)


def random_motions(arms: Arms, batch: int) -> list[jax.Array]:
    """qpos in [-pi, pi] and qvel in [-2, 2] of both arms, on the device."""
    shapes = [(batch, arm.num_joints) for arm in (arms.expert, arms.learner) for _ in range(2)]

    @jax.jit
    def draw() -> list[jax.Array]:
        keys, bounds = jax.random.split(jax.random.key(0), 4), (np.pi, 2.0, np.pi, 2.0)
        drawn = zip(keys, shapes, bounds, strict=True)
        return [jax.random.uniform(key, shape, minval=-bound, maxval=bound) for key, shape, bound in drawn]

    return draw()


@functools.cache
def reference_function(arms: Arms, quantity: str) -> Callable[..., Any]:
    return jax.jit(batched(jax_distance("composition", arms), quantity))


def reference(arms: Arms, motions: Sequence[jax.Array], quantity: str) -> Any:
    """Value and gradients of the first pairs in double precision, on the CPU."""
    numbers = [np.asarray(x[:CHECKED], np.float64) for x in motions]
    with jax.enable_x64(True), jax.default_device(jax.devices("cpu")[0]):
        return jax.tree.map(np.asarray, reference_function(arms, quantity)(*numbers))


def run_jax(method: str, arms: Arms, batch: int, quantity: str) -> Row:
    """A measurement of a method in JAX."""
    motions = random_motions(arms, batch)
    timing = time_program(batched(jax_distance(method, arms), quantity), *motions)
    values = jax.tree.map(lambda x: np.asarray(x[:CHECKED]), timing.result)
    return _row(timing, batch, values, reference(arms, motions, quantity))


def run_torch(method: str, arms: Arms, batch: int, quantity: str) -> Row:
    """A measurement of PyTorch on the same numbers."""
    import torch  # pyright: ignore[reportMissingImports]

    device = "cuda" if jax.default_backend() == "gpu" else "cpu"
    motions = random_motions(arms, batch)
    inputs = [torch.as_tensor(np.array(x), device=device) for x in motions]
    motions = [x[:CHECKED] for x in motions]  # frees the memory for PyTorch
    by = QUANTITIES[quantity]
    for index in by:
        inputs[index].requires_grad_()
    matrix = np.asarray(METRIC.make_correspondence(arms.expert, arms.learner))
    distance = kernel_peers.torch_distance(arms.expert, arms.learner, matrix, WEIGHTS, device=device)
    if method == "torch.compile":
        distance = torch.compile(distance)

    def call() -> Any:
        value = distance(*inputs)
        return (value, torch.autograd.grad(value.sum(), [inputs[k] for k in by])) if by else value

    def wait(_: Any) -> None:
        if device == "cuda":
            torch.cuda.synchronize()

    timing = time_call(call, wait)
    values = jax.tree.map(lambda x: x[:CHECKED].detach().cpu().numpy(), timing.result)
    return _row(dataclasses.replace(timing, compile=timing.first), batch, values, reference(arms, motions, quantity))


def _row(timing: Timing, batch: int, values: Any, expected: Any) -> Row:
    value, *gradients = (
        float(np.abs(a - b).max()) for a, b in zip(*map(jax.tree.leaves, (values, expected)), strict=True)
    )
    error = {"value": value, **({"gradient": max(gradients)} if gradients else {})}
    return {**timing.summary(), "pairs_per_s": batch / timing.median, "largest_error": error}


def missing_torch() -> str | None:
    """Why PyTorch cannot be measured, if so."""
    try:
        import torch  # pyright: ignore[reportMissingImports]
    except ImportError:
        return "PyTorch is not installed"
    return None if torch.cuda.is_available() or jax.default_backend() == "cpu" else "PyTorch without CUDA"


def sweep(name: str, cases: dict[int, tuple[Arms, int]], method: str) -> Iterator[Row]:
    """A method on cases of increasing size; it ends with the first one that fails or takes too long."""
    run = run_torch if method.startswith("torch") else run_jax
    for quantity in QUANTITIES if method == "mimic" else ("value", "gradient"):
        for size, (arms, batch) in cases.items():
            row: Row = {"sweep": name, "size": size, "batch": batch, "method": method, "quantity": quantity}
            try:
                row |= run(method, arms, batch, quantity)
            except Exception as error:  # the types for lack of memory differ by backend
                row |= failure(error)
            yield row
            if "failed" in row or row["median_ms"] > 1e3 * LONGEST:
                break
    if method.startswith("torch"):
        kernel_peers.free_torch_memory()


def limits() -> dict[str, float]:
    """Bytes per second of a copy, read and written, and floating point operations per second."""
    numbers, length = jnp.zeros(2 ** TWO_TO["copy"], jnp.float32), 512
    copy = time_program(lambda x: x + 1, numbers).median
    few = jnp.ones(2 ** TWO_TO["multiply_add"], jnp.float32)
    added = time_program(lambda x: functools.reduce(lambda y, _: y * 0.999 + x, range(length), x), few).median
    return {"copy_bytes_per_second": 2 * numbers.nbytes / copy, "flops": 2 * length * few.size / added}


COLUMNS = {
    "sweep": "{sweep}",
    "size": "{size:g}",
    "method": "{method}",
    "quantity": "{quantity}",
    "pairs/s": "{pairs_per_s:.3g}",
    "spread": "{spread:.1%}",
    "compile [s]": "{compile_s:.1f}",
    "error": "{largest_error[value]:.1e}",
    "error of gradient": "{largest_error[gradient]:.1e}",
}


def main() -> None:
    os.environ.setdefault("XLA_PYTHON_CLIENT_PREALLOCATE", "false")  # PyTorch needs memory too
    on_gpu = jax.default_backend() == "gpu"
    parser = BenchmarkParser("kernel", __doc__)
    parser.add_numbers("--batches", BATCHES if on_gpu else BATCHES[:5], "pairs of Pandas", float)
    parser.add_numbers("--links", LINKS, "of both planar arms")
    parser.add_argument("--link-batch", type=float, default=1e6 if on_gpu else 1e3, metavar="N", help="pairs of those")
    parser.add_names("--methods", METHODS)
    options = parser.parse_args()
    missing = missing_torch()
    absent = {method: missing for method in options.methods if missing and method.startswith("torch")}
    panda, link_batch = panda_pair(), int(options.link_batch)
    sweeps = {
        "batch": {int(batch): (panda, int(batch)) for batch in sorted(options.batches)},
        "links": {links: (planar_pair(links), link_batch) for links in sorted(options.links)},
    }
    results, device, rows = Results("kernel", options), limits(), []
    methods = [method for method in METHODS if method in options.methods and method not in absent]
    for method, (name, cases) in itertools.product(methods, sweeps.items()):
        for row in sweep(name, cases, method):
            rows.append(row)
            results.write(limits=device, absent=absent, results=rows)
    if results.figure:
        plot(rows, device, results.figure)
    print_table(rows, COLUMNS)
    print(f"copy: {device['copy_bytes_per_second'] / 1e9:,.0f} GB/s; multiply-adds: {device['flops'] / 1e9:,.0f} GFLOP/s")


if __name__ == "__main__":
    main()
