"""The metric's kernel: from joint motions of two arms to their embodiment distance, and its gradient.

    python -m benchmarks.kernel [--out FILE] [--batches 1e2 ... 1e8] [--links 3 ... 64] [--methods mimic ...]

All methods compute the same: forward kinematics with velocities, link distances with the default weights and
correspondence (`MetricConfig`), the mean; "gradient" is the value with the gradient by the learner's qpos and qvel,
"all" by both arms'. The pairs of poses are made on the device. Batches are of the Panda with 7 joints and the one with
4; links are of two planar arms with as many. `mimic` is `motion_distance`, `composition` its parts as they are called
one by one, `matrices` a straightforward JAX program on 4x4 matrices, `torch` the same in PyTorch, where it is
installed. What does not fit into memory, or follows a case of more than PATIENCE seconds a call, has no figures. Limits
of the device, from the same run: memory traffic of a copy, and the rate of fused multiply-adds.
"""

import argparse
import dataclasses
import functools
import itertools
import os
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, cast

import jax
import jax.numpy as jnp
import numpy as np
from rich.console import Console
from rich.table import Table

import mimic
from benchmarks import kernel_peers
from benchmarks.kernel_figure import plot
from benchmarks.record import write_results
from benchmarks.timing import Timing, compiled, time_call
from mimic.metric.config import MetricConfig

BATCHES = (1e2, 1e3, 1e4, 1e5, 1e6, 1e7, 1e8)
LINKS = (3, 4, 7, 16, 32, 64)
METHODS = ("torch", "torch.compile", "mimic", "composition", "matrices")  # JAX keeps the memory that it took
QUANTITIES = {"value": (), "gradient": (2, 3), "all": (0, 1, 2, 3)}  # what is differentiated by
METRIC = MetricConfig()
WEIGHTS = cast(mimic.DistanceWeights, METRIC.make_weights())  # constants, in the default metric
PATIENCE = 1.0  # s a call; the next case is about ten times as large
JUDGED = 1000  # pairs that are compared with double precision
TWO_TO = {"copy": 26, "multiply_add": 22}  # numbers that the limits are measured with

Function = Callable[..., Any]


@dataclasses.dataclass(frozen=True, eq=False)  # itself alone, for what is cached of it
class Arms:
    expert: mimic.Embodiment
    learner: mimic.Embodiment


def panda_pair() -> Arms:
    return Arms(mimic.panda(), mimic.panda(locked=(3, 6, 7)))


def planar_pair(links: int) -> Arms:
    """Two arms of different proportions."""
    rng = np.random.default_rng(links)
    return Arms(*(mimic.planar_arm(rng.uniform(0.5, 1.5, links) / links) for _ in range(2)))


def jax_distance(method: str, arms: Arms) -> Function:
    """Of one sample."""
    correspondence = METRIC.make_correspondence(arms.expert, arms.learner)
    if method == "mimic":
        return mimic.motion_distance(arms.expert, arms.learner, correspondence, WEIGHTS)
    if method == "matrices":
        return kernel_peers.matrix_distance(arms.expert, arms.learner, np.asarray(correspondence), WEIGHTS)

    def composition(*motion: jax.Array) -> jax.Array:
        states = mimic.link_states(arms.expert, *motion[:2]), mimic.link_states(arms.learner, *motion[2:])
        return mimic.embodiment_distance(*states, correspondence, WEIGHTS)

    return composition


def batched(distance: Function, quantity: str) -> Function:
    by = QUANTITIES[quantity]
    return jax.vmap(jax.value_and_grad(distance, by) if by else distance)


def random_motions(arms: Arms, batch: int) -> list[jax.Array]:
    """qpos in [-pi, pi] and qvel in [-2, 2] of both arms, on the device."""
    widths = [arm.num_joints for arm in (arms.expert, arms.learner) for _ in range(2)]

    @jax.jit
    def draw() -> list[jax.Array]:
        keys = list(jax.random.split(jax.random.key(0), 4))
        largest = np.pi, 2.0, np.pi, 2.0
        drawn = zip(keys, widths, largest, strict=True)
        return [jax.random.uniform(key, (batch, n), minval=-most, maxval=most) for key, n, most in drawn]

    return draw()


@functools.cache
def reference_program(arms: Arms, quantity: str) -> Function:
    return jax.jit(batched(jax_distance("composition", arms), quantity))


def reference(arms: Arms, motions: Sequence[jax.Array], quantity: str) -> Any:
    """Value and gradients of the first pairs in double precision, on the CPU."""
    numbers = [np.asarray(x[:JUDGED], np.float64) for x in motions]
    with jax.enable_x64(True), jax.default_device(jax.devices("cpu")[0]):
        return jax.tree.map(np.asarray, reference_program(arms, quantity)(*numbers))


def run_jax(method: str, arms: Arms, batch: int, quantity: str) -> dict[str, Any]:
    motions = random_motions(arms, batch)
    program, compile_s = compiled(batched(jax_distance(method, arms), quantity), *motions)
    timing = dataclasses.replace(time_call(lambda: program(*motions)), compile=compile_s)
    found = jax.tree.map(lambda x: np.asarray(x[:JUDGED]), program(*motions))
    return {**_figures(timing, batch), "largest_error": largest_error(found, arms, motions, quantity)}


def _figures(timing: Timing, batch: int) -> dict[str, float]:
    return {**timing.summary(), "pairs_per_s": batch / timing.median}


def run_torch(method: str, arms: Arms, batch: int, quantity: str) -> dict[str, Any]:
    """PyTorch on the same numbers."""
    import torch  # pyright: ignore[reportMissingImports]

    device = "cuda" if jax.default_backend() == "gpu" else "cpu"
    motions = random_motions(arms, batch)
    inputs = [torch.as_tensor(np.array(x), device=device) for x in motions]
    motions = [x[:JUDGED] for x in motions]  # the rest is PyTorch's now, and its memory too
    by = QUANTITIES[quantity]
    for index in by:
        inputs[index].requires_grad_()
    matrix = np.asarray(METRIC.make_correspondence(arms.expert, arms.learner))
    distance = kernel_peers.torch_distance(arms.expert, arms.learner, matrix, WEIGHTS, device)
    if method == "torch.compile":
        distance = torch.compile(distance)

    def call() -> Any:
        value = distance(*inputs)
        return (value, torch.autograd.grad(value.sum(), [inputs[k] for k in by])) if by else value

    def wait(_: Any) -> None:
        if device == "cuda":
            torch.cuda.synchronize()

    began = time.perf_counter()
    found = call()
    wait(found)
    first_call = time.perf_counter() - began
    found = jax.tree.map(lambda x: x[:JUDGED].detach().cpu().numpy(), found)
    timing = dataclasses.replace(time_call(call, wait), compile=first_call)
    return {**_figures(timing, batch), "largest_error": largest_error(found, arms, motions, quantity)}


def largest_error(found: Any, arms: Arms, motions: Sequence[jax.Array], quantity: str) -> dict[str, float]:
    expected = reference(arms, motions, quantity)
    value, *gradients = (
        float(np.abs(a - b).max()) for a, b in zip(*map(jax.tree.leaves, (found, expected)), strict=True)
    )
    return {"value": value, **({"gradient": max(gradients)} if gradients else {})}


def available(methods: Sequence[str]) -> dict[str, str | None]:
    """For each method why it cannot run, if so."""
    try:
        import torch  # pyright: ignore[reportMissingImports]

        missing = None if torch.cuda.is_available() or jax.default_backend() == "cpu" else "PyTorch without CUDA"
    except ImportError:
        missing = "PyTorch is not installed"
    return {method: missing if method.startswith("torch") else None for method in methods}


def sweep(name: str, cases: dict[int, tuple[Arms, int]], method: str, console: Console) -> Iterator[dict[str, Any]]:
    """A method on cases that grow; one that was too large for it is its last."""
    run = run_torch if method.startswith("torch") else run_jax
    for quantity in QUANTITIES if method == "mimic" else ("value", "gradient"):
        for size, (arms, batch) in cases.items():
            row: dict[str, Any] = {"sweep": name, "size": size, "batch": batch}
            row |= {"method": method, "quantity": quantity}
            try:
                row |= run(method, arms, batch, quantity)
            except Exception as error:  # the kinds for memory differ by backend; the message is in the file
                yield row | {"failed": f"{type(error).__name__}: {error}"[:200]}
                console.print(f"{name} {size:g}, {method}, {quantity}: {type(error).__name__}", markup=False)
                break
            yield row
            if row["median_ms"] > 1e3 * PATIENCE:
                break
    if method.startswith("torch"):
        kernel_peers.give_memory_back()


def limits() -> dict[str, float]:
    """Bytes per second of a copy, read and written, and floating point operations per second."""
    numbers = jnp.zeros(2 ** TWO_TO["copy"], jnp.float32)
    copy = jax.jit(lambda x: x + 1).lower(numbers).compile()
    copied = time_call(lambda: copy(numbers)).median
    few, length = jnp.ones(2 ** TWO_TO["multiply_add"], jnp.float32), 512

    @jax.jit
    def multiply_add(x: jax.Array) -> jax.Array:
        return functools.reduce(lambda y, _: y * 0.999 + x, range(length), x)

    program = multiply_add.lower(few).compile()
    added = time_call(lambda: program(few)).median
    return {"copy_bytes_per_second": 2 * numbers.nbytes / copied, "flops": 2 * length * few.size / added}


def print_table(results: Sequence[dict[str, Any]], device: dict[str, float], console: Console) -> None:
    heads = "sweep", "size", "method", "quantity", "pairs/s", "spread", "compile [s]", "error", "error of gradient"
    table = Table(*heads)
    for row in (row for row in results if "median_ms" in row):
        error = row["largest_error"]
        table.add_row(
            row["sweep"],
            f"{row['size']:g}",
            row["method"],
            row["quantity"],
            f"{row['pairs_per_s']:.3g}",
            f"{row['spread']:.1%}",
            f"{row['compile_s']:.1f}",
            f"{error['value']:.1e}",
            f"{error['gradient']:.1e}" if "gradient" in error else "",
        )
    console.print(table)
    console.print(
        f"A copy moves {device['copy_bytes_per_second'] / 1e9:,.0f} GB/s; multiply-adds run at "
        f"{device['flops'] / 1e9:,.0f} GFLOP/s."
    )


def main() -> None:
    """Runs both sweeps, and writes the file after each case."""
    os.environ.setdefault("XLA_PYTHON_CLIENT_PREALLOCATE", "false")  # PyTorch needs memory too
    on_gpu = jax.default_backend() == "gpu"
    parser = argparse.ArgumentParser(prog="python -m benchmarks.kernel", description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--out", type=Path, help="file of results, with a plot beside it; printed only where not given")
    parser.add_argument("--batches", type=float, nargs="*", default=BATCHES if on_gpu else BATCHES[:5], metavar="N")
    parser.add_argument("--links", type=int, nargs="*", default=LINKS, metavar="N", help="of both planar arms")
    parser.add_argument("--link-batch", type=float, default=1e6 if on_gpu else 1e3, metavar="N", help="pairs of those")
    parser.add_argument("--methods", nargs="+", choices=METHODS, default=METHODS)
    parser.add_argument("--commit", help="what the results are of, where this is no git checkout")
    options = parser.parse_args()
    absent = available([method for method in METHODS if method in options.methods])
    methods = [method for method, missing in absent.items() if missing is None]
    panda, link_batch = panda_pair(), int(options.link_batch)
    sweeps = {
        "batch": {int(batch): (panda, int(batch)) for batch in sorted(options.batches)},
        "links": {links: (planar_pair(links), link_batch) for links in sorted(options.links)},
    }
    console = Console(width=120)  # also where there is no terminal
    device, results = limits(), []
    absentees = {method: missing for method, missing in absent.items() if missing}
    for method, (name, cases) in itertools.product(methods, sweeps.items()):
        for row in sweep(name, cases, method, console):
            results.append(row)
            if options.out:
                content = {"limits": device, "absent": absentees, "results": results}
                write_results(options.out, "kernel", options.commit, **content)
    if options.out:
        plot(results, device, options.out.with_suffix(".png"))
    print_table(results, device, console)


if __name__ == "__main__":
    main()
