"""The metric's kernel: from joint motions of two arms to their embodiment distance and its gradient.

    python -m benchmarks.kernel [--out FILE] [--batches 1e2 ... 1e8] [--methods mimic ...]

All methods compute the embodiment distance of joint positions and velocities in the default metric; "gradient" also
its gradient with respect to the learner's motion, "all" to that of both arms. Batches are of the Panda with 7 joints
and the one with 4. `mimic` is `motion_distance` of the links, "mimic, with hands" that of the default metric,
`composition` the parts of the first called separately. Limits of the device are the memory traffic of a copy, and the
rate of fused multiply-adds.
"""

import functools
from collections.abc import Callable, Iterator, Sequence
from typing import Any, cast

import jax
import jax.numpy as jnp
import numpy as np

import mimic
from benchmarks.common.parser import make_parser
from benchmarks.common.record import Row, collect, failure, print_table
from benchmarks.common.timing import time_program
from mimic.metric.config import MetricConfig

BATCHES = (1e2, 1e3, 1e4, 1e5, 1e6, 1e7, 1e8)
HAND = "mimic, with hands"
METHODS = ("mimic", HAND, "composition")
QUANTITIES = {"value": (), "gradient": (2, 3), "all": (0, 1, 2, 3)}  # arguments of the gradient
METRIC = MetricConfig()
WEIGHTS = cast(mimic.DistanceWeights, METRIC.make_weights())  # constants, in the default metric
HANDS = mimic.HandWeights(METRIC.hand_rotation, METRIC.hand_position)
LONGEST = 1.0  # s a call; the next case is about ten times as large
CHECKED = 1000  # pairs that are compared with double precision
COLUMNS = (
    "size:g method quantity pairs_per_s:.3g spread:.1% compile_s:.1f largest_error[value]:.1e "
    "largest_error[gradient]:.1e"
)


class Arms:
    """Two arms and their correspondence; compared by identity, as the key of a cache."""

    def __init__(self, expert: mimic.Embodiment, learner: mimic.Embodiment):
        self.expert, self.learner = expert, learner
        self.correspondence = np.asarray(METRIC.make_correspondence(expert, learner))


def jax_function(method: str, arms: Arms, quantity: str) -> Callable[..., Any]:
    case = arms.expert, arms.learner, arms.correspondence, WEIGHTS

    hands: Any = {"hand_weights": HANDS} if "hands" in method else {}

    def composition(*motion: jax.Array) -> jax.Array:
        states = mimic.link_states(arms.expert, *motion[:2]), mimic.link_states(arms.learner, *motion[2:])
        return mimic.embodiment_distance(*states, *case[2:], **hands)

    with_hands = functools.partial(mimic.motion_distance, **hands)
    make = {"mimic": mimic.motion_distance, HAND: with_hands}
    distance, by = make.get(method, lambda *_: composition)(*case), QUANTITIES[quantity]
    return jax.vmap(jax.value_and_grad(distance, by) if by else distance)


def random_motions(arms: Arms, batch: int) -> list[jax.Array]:
    """qpos in [-pi, pi] and qvel in [-2, 2] of both arms, on the device."""
    keys = jax.random.split(jax.random.key(0), 4)
    shapes = [(batch, arm.num_joints) for arm in (arms.expert, arms.learner) for _ in range(2)]
    drawn = zip(keys, shapes, (np.pi, 2.0, np.pi, 2.0), strict=True)
    return [jax.random.uniform(key, shape, minval=-bound, maxval=bound) for key, shape, bound in drawn]


@functools.cache
def _compiled_reference(method: str, arms: Arms, quantity: str) -> Callable[..., Any]:
    return jax.jit(jax_function(method, arms, quantity))


def reference(method: str, arms: Arms, motions: Sequence[jax.Array], quantity: str) -> Any:
    """Value and gradients of the first pairs in double precision, on the CPU."""
    with jax.enable_x64(True), jax.default_device(jax.devices("cpu")[0]):
        name = "composition, with hands" if method == HAND else "composition"
        values = _compiled_reference(name, arms, quantity)(*(np.asarray(x[:CHECKED], np.float64) for x in motions))
        return jax.tree.map(np.asarray, values)


def run(method: str, arms: Arms, batch: int, quantity: str) -> Row:
    motions = random_motions(arms, batch)
    timing = time_program(jax_function(method, arms, quantity), *motions)
    values = jax.tree.map(lambda x: np.asarray(x[:CHECKED]), timing.result)
    pairs = zip(*map(jax.tree.leaves, (values, reference(method, arms, motions, quantity))), strict=True)
    value, *gradients = (float(np.abs(a - b).max()) for a, b in pairs)
    error = {"value": value, **({"gradient": max(gradients)} if gradients else {})}
    return {**timing.summary(), "pairs_per_s": batch / timing.median, "largest_error": error}


def sweep(arms: Arms, batches: Sequence[int], method: str) -> Iterator[Row]:
    """A method on batches of increasing size; it ends with the first one that fails or takes too long."""
    for quantity in QUANTITIES if method in ("mimic", HAND) else ("value", "gradient"):
        for batch in batches:
            row: Row = {"size": batch, "method": method, "quantity": quantity}
            try:
                row |= run(method, arms, batch, quantity)
            except Exception as error:  # the types for lack of memory differ by backend
                row |= failure(error)
            yield row
            if "failed" in row or row["median_ms"] > 1e3 * LONGEST:
                break


def limits() -> dict[str, float]:
    """Bytes per second of a copy, read and written, and floating point operations per second."""
    many, few, length = jnp.zeros(2**26, jnp.float32), jnp.ones(2**22, jnp.float32), 512
    copy = time_program(lambda x: x + 1, many).median
    added = time_program(lambda x: functools.reduce(lambda y, _: y * 0.999 + x, range(length), x), few).median
    return {"copy_bytes_per_second": 2 * many.nbytes / copy, "flops": 2 * length * few.size / added}


def main() -> None:
    lists = {"batches": list(BATCHES if jax.default_backend() == "gpu" else BATCHES[:5]), "methods": METHODS}
    options = make_parser("kernel", __doc__, **lists).parse_args()
    panda, batches = Arms(mimic.panda(), mimic.panda(locked=(3, 6, 7))), sorted(map(int, options.batches))
    methods = [method for method in METHODS if method in options.methods]
    rows = (row for method in methods for row in sweep(panda, batches, method))
    device = limits()
    collect(options, rows, "results", COLUMNS, limits=device)
    print_table([device], "copy_bytes_per_second:.3g flops:.3g")


if __name__ == "__main__":
    main()
