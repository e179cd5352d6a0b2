"""Two Pandas imitate both arms of a captured person, without and with the cost of self-collision.

    python -m benchmarks.bimanual CLIP.bvh --out FILE [--rate 10]

For `imitate_trajectory` at the captured speed: measures of similarity; the smallest distance of capsules of different
arms, and of the same arm [m]; the fraction of samples in which these are closer than 2 cm.
"""

import tempfile
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

import mimic
from benchmarks.common.parser import make_parser
from benchmarks.common.record import Row, print_table, write_results
from mimic.arms.arm import ArmConfig
from mimic.commands.capture import fixed_fraction, read_arm
from mimic.commands.config import CaptureConfig
from mimic.envs.config import EnvConfig
from mimic.metric.capsule_distances import capsule_axes, changing_pairs, pair_distances
from mimic.metric.config import MetricConfig
from mimic.metric.similarity import centre_line_table, similarity
from mimic.motions.mocap.ball_chain import ball_chain_motion, ball_chain_xml, zero_frames
from mimic.motions.mocap.link_motion import BOTH

_PAIR = ArmConfig("panda_pair")
_LIMITS = "none"  # as in env=bimanual
_SPEED = 15.0  # rad/s, of a joint
_STARTS = 8  # random initial guesses: each takes a minute of one core with the cost
_CLOSE = 0.02  # m
# The cost is 0 from its clearance on; below, the distance pulls against it, so that it keeps less than its clearance.
COSTS = {"with": mimic.Costs(self_collision=10.0, clearance=0.05), "without": None}


def read_both_arms(clip: Path, learner: mimic.Embodiment, rate: float) -> tuple[mimic.Embodiment, np.ndarray]:
    """The person's arms as a tree of two chains, and their poses at a rate [1/s]."""
    capture = read_arm(clip, BOTH, CaptureConfig(), fixed_fraction(learner))
    part = max(capture.parts, key=lambda part: len(part.start))
    zero = zero_frames(part)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "person.xml"
        path.write_text(ball_chain_xml(part, zero))
        expert = mimic.load_mjcf(path, tip=["*"])
    return expert, ball_chain_motion(part, zero)[0][:: max(1, round(part.rate / rate))]


def imitated(
    expert: mimic.Embodiment,
    learner: mimic.Embodiment,
    capsules: mimic.Capsules,
    qpos: np.ndarray,
    rate: float,
    costs: mimic.Costs | None,
) -> np.ndarray:
    """The learner's motion, by the default metric."""
    metric, poses = MetricConfig().build(expert, learner), jnp.asarray(qpos, jnp.float32)
    moved = mimic.imitate_trajectory(
        expert, learner, poses, **metric.arguments,
        largest_jump=_SPEED / rate, starts=_STARTS, costs=costs, capsules=capsules,
    )  # fmt: skip
    return np.asarray(moved.qpos)


def capsule_distances(arm: mimic.Embodiment, capsules: mimic.Capsules, qpos: np.ndarray) -> dict[str, np.ndarray]:
    """Smallest distance of capsules of different arms, and of the same arm, at each time [m].

    Without pairs whose distance no joint changes: one of a Panda's wrist is always 2.0 cm.
    """
    of_pose = jax.jit(jax.vmap(lambda q: pair_distances(capsules, *capsule_axes(arm, capsules, q))))
    distances, changing = np.asarray(of_pose(jnp.asarray(qpos))), changing_pairs(arm, capsules)
    sides = np.sign(capsules.start[:, 1])  # in the zero pose each arm is upright at its side
    are_apart = np.array([sides[i] != sides[j] for i, j in capsules.pairs])
    kinds = {"between_arms": are_apart, "within_arm": ~are_apart}
    return {name: distances[:, pairs & changing].min(axis=1) for name, pairs in kinds.items()}


def measure(
    expert: mimic.Embodiment, learner: mimic.Embodiment, capsules: mimic.Capsules, poses: tuple[np.ndarray, np.ndarray]
) -> Row:
    """Measures of a motion, from the poses of the expert and of the learner."""
    lines = centre_line_table(expert, poses[0]), centre_line_table(learner, np.asarray(poses[1], float))
    means = {name: float(np.mean(value)) for name, value in similarity(*lines).items()}
    closest = capsule_distances(learner, capsules, poses[1])
    row: Row = dict(means)
    for name, distance in closest.items():
        row |= {f"{name}_minimum_m": float(distance.min()), f"{name}_closer": float(np.mean(distance < _CLOSE))}
    return row


def main() -> None:
    parser = make_parser("bimanual", __doc__, rate=10.0)
    parser.add_argument("clip", type=Path)
    options = parser.parse_args()
    learner = EnvConfig("bimanual", learner=_PAIR, limits=_LIMITS).build_arms().learner.embodiment
    capsules = mimic.fit_capsules(_PAIR, _LIMITS)
    expert, qpos = read_both_arms(options.clip, learner, options.rate)
    rows: list[Row] = []
    for name, costs in COSTS.items():
        own = imitated(expert, learner, capsules, qpos, options.rate, costs)
        rows.append({"cost": name, **measure(expert, learner, capsules, (qpos, own))})
    write_results(options, clip=options.clip.name, rate=options.rate, samples=len(qpos), results=rows)
    print_table(
        rows, "cost centre_line_distance:.4f tangent_angle_deg:.1f between_arms_minimum_m:.3f within_arm_minimum_m:.3f"
    )


if __name__ == "__main__":
    main()
