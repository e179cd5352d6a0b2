"""What each cost of retargeting does to motions: similarity to the expert, and the quantity that the cost is for.

    python -m benchmarks.costs [--out FILE] [--motions 8] [--only NAME ...]

`imitate_trajectory` moves a Panda with joints 3, 6 and 7 locked like one with seven joints, both in their hardware
limits. Motions are demonstrations, which keep off the floor, and splines through random poses, which do not. Each
row adds one cost in one weight; the first row has none, the last all. Each compiles, for half a minute on two cores.
"""

from collections.abc import Iterator

import jax
import jax.numpy as jnp
import numpy as np
from scipy.interpolate import CubicSpline

import mimic
from benchmarks.common.parser import make_parser
from benchmarks.common.record import Row, collect
from mimic.arms.arm import ArmConfig, build_arm
from mimic.arms.capsules import Capsules
from mimic.arms.embodiment import Embodiment
from mimic.metric.capsule_distances import capsule_axes, pair_distances
from mimic.metric.config import MetricConfig
from mimic.metric.similarity import centre_line_table, similarity
from mimic.retargeting.costs import Costs, home_cost, limit_cost

LIMITS = "hardware"
EXPERT, LEARNER = ArmConfig(), ArmConfig(locked=[3, 6, 7])
STEPS, KNOTS = 51, 5  # samples of a motion, and poses of a spline
COSTS = {
    "none": Costs(),
    "hand_position": Costs(hand_position=10.0),
    "home": Costs(home=0.3),
    "limits": Costs(limits=3.0),
    "velocity": Costs(velocity=10.0),
    "acceleration": Costs(acceleration=10.0),
    "self_collision": Costs(self_collision=0.3),
    "floor": Costs(floor=0.3),
    "all": Costs(10.0, 0.3, 3.0, 10.0, 10.0, 0.3, 0.3),
}
COLUMNS = (
    "motions cost distance:.3f similarity[centre_line_distance]:.3f similarity[frechet_distance]:.3f "
    "similarity[hand_position_error]:.3f similarity[hand_angle_deg]:.1f from_home:.3f at_limits:.4f "
    "step_rms:.4f change_rms:.4f self_collisions:.1% below_floor:.1%"
)


def random_motions(arm: Embodiment, count: int, seed: int = 0) -> np.ndarray:
    """[count, STEPS, joints] cubic splines through random poses, cut off at the joint limits."""
    lower, upper = np.asarray(arm.joint_range).T
    poses = np.random.default_rng(seed).uniform(lower, upper, (count, KNOTS, arm.num_joints))
    motions = CubicSpline(np.linspace(0, 1, KNOTS), poses, axis=1)(np.linspace(0, 1, STEPS))
    return np.clip(motions, lower, upper).astype(np.float32)


def effects(arm: Embodiment, capsules: Capsules, motions: np.ndarray) -> Row:
    """What the costs are for: mean squared distance from home and intrusion into the ends of the joint ranges, as in
    `Costs`; rms change of an angle in a step [rad], and of that change; fraction of poses in collision."""

    @jax.jit
    @jax.vmap
    def of_pose(qpos: jax.Array) -> tuple[jax.Array, ...]:
        start, end = capsule_axes(arm, capsules, qpos)
        moving = np.flatnonzero(np.array(capsules.joint) > 0)  # those that `Costs.floor` counts
        height = jnp.minimum(start[moving, 2], end[moving, 2]) - capsules.radius[moving]
        collides = pair_distances(capsules, start, end).min() < 0
        return home_cost(arm, qpos), limit_cost(arm, qpos), collides, height.min() < 0

    home, limits, collides, below = (float(x.mean()) for x in of_pose(motions.reshape(-1, arm.num_joints)))
    step, change = (float(np.sqrt(np.mean(np.diff(motions, n, axis=1) ** 2))) for n in (1, 2))
    row: Row = {"from_home": home, "at_limits": limits, "step_rms": step, "change_rms": change}
    return row | {"self_collisions": collides, "below_floor": below}


def measure(count: int, names: list[str]) -> Iterator[Row]:
    expert, learner = build_arm(EXPERT, LIMITS), build_arm(LEARNER, LIMITS)
    arms = expert.embodiment, learner.embodiment
    capsules = mimic.fit_capsules(LEARNER, LIMITS)
    metric = MetricConfig().build(*arms).arguments
    recorded = mimic.record_demonstrations(expert, count, horizon=STEPS - 1).qpos.astype(np.float32)
    for name in names:
        for kind, motions in {"demonstrations": recorded, "random": random_motions(arms[0], count)}.items():
            results = [
                mimic.imitate_trajectory(*arms, motion, **metric, costs=COSTS[name], capsules=capsules)
                for motion in motions
            ]
            moved = np.stack([result.qpos for result in results])
            alike = similarity(centre_line_table(arms[0], motions), centre_line_table(arms[1], moved))
            row: Row = {"motions": kind, "cost": name, "distance": float(np.mean([r.distance for r in results]))}
            row["similarity"] = {measure: float(values.mean()) for measure, values in alike.items()}
            yield row | effects(arms[1], capsules, moved)


def main() -> None:
    options = make_parser("costs", __doc__, motions=8, only=COSTS).parse_args()
    weights = {name: {k: v for k, v in vars(cost).items() if v != getattr(Costs(), k)} for name, cost in COSTS.items()}
    collect(options, measure(options.motions, options.only), "rows", COLUMNS, weights=weights)


if __name__ == "__main__":
    main()
