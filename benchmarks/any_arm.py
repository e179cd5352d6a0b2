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
import time
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks.common.parser import make_parser
from benchmarks.common.record import Row, print_table, write_results
from mimic.arms.arm import ArmConfig, build_arm
from mimic.arms.arrays import MAX_JOINTS, ArmArrays, arm_arrays, lock_joints, stack_arms
from mimic.arms.named_arms import named_arms
from mimic.arms.sampler import lock_masks, lock_sampler, random_arm
from mimic.envs import env_config
from mimic.envs.imitation import training_and_held_out
from mimic.envs.many_arms import AnyArmEnv
from mimic.evaluation.rollout_metrics import MIN_SPAN
from mimic.metric.kinematics import link_states
from mimic.metric.similarity import centre_line, similarity
from mimic.retargeting.array_bound import closest_motion

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


def run_arm(env: AnyArmEnv, expert: ArmArrays, arm: ArmArrays) -> dict[str, jax.Array]:
    """Distances and measures of similarity at each step, [demonstrations, time], by name."""
    horizon = env.config.horizon

    def of_demonstration(index: jax.Array, expert_qpos: jax.Array) -> dict[str, jax.Array]:
        start = env.begin(env.start_of(arm, index, jax.random.PRNGKey(0)))

        def step(state: Any, _: None) -> tuple[Any, tuple[jax.Array, jax.Array]]:
            state = env.step(state, jnp.zeros(env.action_size))
            return state, (state.metrics["distance"], state.pipeline_state.qpos)

        _, (distance, qpos) = jax.lax.scan(step, start, None, length=horizon)
        states = jax.vmap(lambda time: env.expert_at(index, time))(jnp.arange(1, horizon + 1))
        metric, at_home = env.metric_of(arm), link_states(arm, arm.home)
        closest = closest_motion(arm, metric, states, qpos)
        home = jnp.broadcast_to(arm.home, qpos.shape)
        poses = {"": qpos, "best_": closest.qpos, "hold_": home}
        line = centre_line(expert, expert_qpos)
        measures = {prefix: similarity(line, centre_line(arm, motion)) for prefix, motion in poses.items()}
        return {
            "distance": distance,
            # A controller below the bound has found a minimum that the search missed.
            "bound": jnp.minimum(closest.distance, distance),
            "hold": jax.vmap(lambda state: metric(state, at_home))(states),
            **{prefix + name: values for prefix, each in measures.items() for name, values in each.items()},
        }

    qpos = env.demonstrations.qpos[:, 1 : horizon + 1]
    padding = [(0, 0), (0, 0), (0, MAX_JOINTS - qpos.shape[-1])]
    return jax.vmap(of_demonstration)(jnp.arange(len(qpos)), jnp.asarray(np.pad(qpos, padding), jnp.float32))


def row(name: str, arm: ArmArrays, outcome: dict[str, np.ndarray]) -> Row:
    """The metrics of an arm."""
    half = outcome["distance"].shape[1] // 2
    gaps = []
    for start in (0, half):
        distance, bound, hold = (outcome[key][:, start:].mean() for key in ("distance", "bound", "hold"))
        gaps.append((distance - bound) / max(hold - bound, 1e-9))
    means = {key: float(values.mean()) for key, values in outcome.items()}
    joints, span = int(np.asarray(arm.is_free).sum()), 1 - means["bound"] / means["hold"]
    return {"arm": name, "joints": joints, "gap": gaps[0], "late": gaps[1], "span": span, **means}


def main() -> None:
    """Runs the benchmark."""
    options: argparse.Namespace = make_parser("any_arm", __doc__, arms=KINDS, demonstrations=8, random=64).parse_args()
    config = env_config("any_arm")
    held_out = training_and_held_out(config)[1].select(slice(0, options.demonstrations))
    panda = arm_arrays(build_arm(ArmConfig()))
    env = AnyArmEnv(config, held_out, lock_sampler(panda, lock_masks(MAX_JOINTS - 1, 1)))
    expert = jax.tree.map(jnp.asarray, panda.astype(np.float32))
    run = jax.jit(lambda arms: jax.lax.map(lambda arm: run_arm(env, expert, arm), arms))
    results: dict[str, list[Row]] = {}
    for kind in options.arms:
        arms = make_arms(kind, options.random)
        if not arms:
            continue
        batch = jax.tree.map(jnp.asarray, stack_arms(list(arms.values())).astype(np.float32))
        began = time.perf_counter()
        outcome = {key: np.asarray(values, float) for key, values in run(batch).items()}
        print(f"{kind}: {len(arms)} arms in {time.perf_counter() - began:.0f} s with compilation")
        rows = [
            row(name, arm, {key: values[i] for key, values in outcome.items()})
            for i, (name, arm) in enumerate(arms.items())
        ]
        results[kind] = rows
        print_table(rows, COLUMNS, title=kind)
        gaps = np.array([each["gap"] for each in rows if each["span"] >= MIN_SPAN])
        print(
            f"gap: mean {gaps.mean():.2%}, median {np.median(gaps):.2%}, largest {gaps.max():.2%} of {len(gaps)} arms"
        )
        write_results(options, demonstrations=options.demonstrations, **results)


if __name__ == "__main__":
    main()
