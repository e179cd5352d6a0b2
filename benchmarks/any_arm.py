"""The controller of any arm without learning, on many arms in one compiled function.

    python -m benchmarks.any_arm [--out FILE] [--arms locks real random] [--demonstrations 8] [--random 64]

Each arm imitates held-out demonstrations of the Panda from its home pose. The gap is that of the means over the
demonstrations, relative to the kinematic bound and to holding the home pose; "late" is the same for the second half of
an episode, when the arm has left its home pose. Measures of similarity are those of the controller, of the poses of the
bound ("best_") and of the home pose ("hold_"). `span` is the fraction of the distance of holding that a best motion
saves: below 25 % a gap means little. Arms are those of the environments panda7dof, panda4dof and panda3dof, the Panda
with one or two joints locked, the real arms of REAL that this machine has by name, with at least the Panda's armature
and damping, and random arms of `random_arm`.
"""

import argparse

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks.common.parser import make_parser
from benchmarks.common.record import Row, print_table, write_results
from mimic.arms.arm import ArmConfig, build_arm
from mimic.arms.arrays import MAX_JOINTS, ArmArrays, arm_arrays, lock_joints
from mimic.arms.named_arms import named_arms
from mimic.arms.sampler import lock_masks, lock_sampler, random_arm
from mimic.envs import env_config
from mimic.envs.family import SEEN, UNSEEN
from mimic.envs.imitation import training_and_held_out
from mimic.envs.many_arms import AnyArmEnv
from mimic.evaluation.evaluator import Evaluator

REAL = ("ur5e", "ur10e", "iiwa", "iiwa14", "kinova3", "gen3", "sawyer", "jaco", "xarm7", "fetch")
KINDS = ("presets", "locks", "real", "random")
PRESETS = {"panda7dof": (), "panda4dof": (3, 6, 7), "panda3dof": (2, 3, 6, 7)}  # locked joints
ARMATURE, DAMPING = 0.1, 1.0  # those of the Panda
COLUMNS = (
    "arm joints gap:.2% late:.2% span:.0% distance:.4f bound:.4f hold:.4f centre_line_distance:.4f "
    "best_centre_line_distance:.4f tangent_angle_deg:.1f best_tangent_angle_deg:.1f"
)


def make_arms(kind: str, count: int) -> dict[str, ArmArrays]:
    """The arms of a kind by name."""
    if kind == "real":
        models = [name for name in REAL if name in named_arms()]
        configs = (ArmConfig(model=name, armature=ARMATURE, damping=DAMPING) for name in models)
        return {name: arm_arrays(build_arm(config)) for name, config in zip(models, configs, strict=True)}
    if kind == "random":
        arms = jax.device_get(jax.vmap(random_arm)(jax.random.split(jax.random.PRNGKey(0), count)))
        return {f"random {i}": jax.tree.map(lambda x, i=i: x[i], arms) for i in range(count)}
    panda = arm_arrays(build_arm(ArmConfig()))
    if kind == "presets":
        numbers = np.arange(1, MAX_JOINTS + 1)
        return {name: lock_joints(panda, np.isin(numbers, locked)) for name, locked in PRESETS.items()}
    masks = lock_masks(MAX_JOINTS - 1, 2)
    return {"+".join(map(str, np.flatnonzero(mask) + 1)): lock_joints(panda, mask) for mask in masks}


def rows_of(env: AnyArmEnv, arms: dict[str, ArmArrays]) -> list[Row]:
    """The metrics of the zero action of each arm."""
    evaluator = Evaluator(env, env.demonstrations, {SEEN: arms, UNSEEN: {}}, lambda: rollouts)
    still = jnp.zeros(env.action_size)
    rollouts = jax.device_get(jax.jit(lambda: evaluator.rollout(lambda state: still))())
    details, home = evaluator.details(rollouts), np.stack([np.asarray(arm.home) for arm in arms.values()])
    held = np.repeat(home, env.demonstrations.count, axis=0)[:, None]
    motions = {"": rollouts.qpos, "best_": evaluator.nearest_poses, "hold_": np.broadcast_to(held, rollouts.qpos.shape)}
    similar = {prefix: evaluator.similarity(qpos) for prefix, qpos in motions.items()}
    # A controller below the bound has found a minimum that the search missed; the references have it.
    curves = rollouts.distance, evaluator.lower_bound, evaluator.hold_distance
    late = slice(rollouts.distance.shape[1] // 2, None)
    result = []
    for _, name, rows in evaluator.groups:
        own, means = details[name], [curve[rows].mean(dtype=float) for curve in curves]
        distance, bound, hold = (curve[rows, late].mean(dtype=float) for curve in curves)
        measures = {
            prefix + key: float(values[rows].mean())
            for prefix, table in similar.items()
            for key, values in table.items()
        }
        gaps = [(x - low) / max(high - low, 1e-9) for x, low, high in (means, (distance, bound, hold))]
        result.append(
            {"arm": name, "joints": own["joints"], "gap": gaps[0], "late": gaps[1], "span": own["span"]}
            | {key: float(mean) for key, mean in zip(("distance", "bound", "hold"), means, strict=True)}
            | measures
        )
    return result


def main() -> None:
    """Runs the benchmark."""
    options: argparse.Namespace = make_parser("any_arm", __doc__, arms=KINDS, demonstrations=8, random=64).parse_args()
    config = env_config("any_arm")
    held_out = training_and_held_out(config)[1].select(slice(0, options.demonstrations))
    panda = arm_arrays(build_arm(ArmConfig()))
    env = AnyArmEnv(config, held_out, lock_sampler(panda, lock_masks(MAX_JOINTS - 1, 1)))
    results: dict[str, list[Row]] = {}
    for kind in options.arms:
        arms = make_arms(kind, options.random)
        if not arms:
            continue
        results[kind] = rows_of(env, arms)
        print_table(results[kind], COLUMNS, title=kind)
        write_results(options, demonstrations=options.demonstrations, **results)


if __name__ == "__main__":
    main()
