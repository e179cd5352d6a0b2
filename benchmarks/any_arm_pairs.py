"""A pose mapper from any arm to any arm, on pairs of real and random arms.

    python -m benchmarks.any_arm_pairs --run runs/NAME --models DIR --out FILE [--poses 128]

The run is one of `trainer=pose_mapper` with `env.arms.expert=drawn`; of a run with a fixed expert only the pairs with
that expert are evaluated. The models are the files DIR/*.xml; each has at least the run's `env.arms.armature` and
`env.arms.damping`. Each pair has its own random poses of the expert. A quality is that of the run's report: 0 is the
nearest pose that anything found, 1 a random pose.
"""

import functools
import itertools
from collections.abc import Mapping
from pathlib import Path

import jax
import numpy as np

from benchmarks.common.parser import make_parser
from benchmarks.common.record import Row, print_table, write_results
from mimic.arms.arm import ArmConfig
from mimic.arms.arrays import ArmArrays, stack_arms
from mimic.base.files import read_json
from mimic.envs.family import UNSEEN, arms_config, report_arms
from mimic.runs.files import REPORT
from mimic.trainers.pose_mapper.any_arm_evaluation import METHODS, Pairs, make_reference, run_mapper, table_of_pairs
from mimic.trainers.pose_mapper.any_arm_mapper import AnyArmMapper
from mimic.trainers.pose_mapper.any_arm_training import random_pose

SEED = 2**21  # not that of a training or of its report
COLUMNS = " ".join(["group", "pairs", *(f"{name}:.2%" for name in METHODS), "largest:.2%"])
ENV = "ENV"  # name of the environment's expert


def groups_of_pairs(
    mapper: AnyArmMapper, real: Mapping[str, ArmArrays], random: Mapping[str, ArmArrays]
) -> dict[str, list[tuple[str, str]]]:
    """Names of expert and learner of each pair, in groups; ENV is the environment's expert."""
    groups = {"ENV to real": [(ENV, arm) for arm in real], "ENV to random": [(ENV, arm) for arm in random]}
    if mapper.model.expert_is_drawn:
        names = list(random)
        groups |= {
            "real to ENV": [(arm, ENV) for arm in real],
            "real to real": list(itertools.permutations(real, 2)),
            "random to random": list(zip(names, names[1:] + names[:1], strict=True)),
        }
    return groups


def evaluate(mapper: AnyArmMapper, experts: list[ArmArrays], learners: list[ArmArrays], poses: int) -> list[Row]:
    """The metrics of each pair, see `table_of_pairs`."""
    first, second = (stack_arms([arm.astype(np.float32) for arm in arms]) for arms in (experts, learners))
    key_poses, key_guesses = jax.random.split(jax.random.key(SEED))
    keys = jax.random.split(key_poses, (len(experts), poses))
    pairs = Pairs(first, second, jax.jit(jax.vmap(jax.vmap(random_pose, (None, 0))))(first, keys))
    reference = jax.device_get(jax.jit(functools.partial(make_reference, mapper.model))(key_guesses, pairs))
    mapped = jax.device_get(jax.jit(functools.partial(run_mapper, mapper.model))(mapper.params, pairs))
    columns = table_of_pairs(reference, mapped)
    return [{key: float(column[i]) for key, column in columns.items()} for i in range(len(experts))]


def summary(group: str, rows: list[Row]) -> Row:
    """Means over the pairs of a group, and the largest quality of a pair."""
    means = {key: float(np.mean([row[key] for row in rows])) for key in METHODS}
    return {"group": group, "pairs": len(rows), **means, "largest": max(row["quality"] for row in rows)}


def main() -> None:
    options = make_parser("any_arm_pairs", __doc__, run=Path, models=Path, poses=128).parse_args()
    mapper = AnyArmMapper.load(options.run)
    own = arms_config(mapper.env)
    configs = {
        file.stem: ArmConfig(model=str(file), armature=own.armature, damping=own.damping)
        for file in sorted(options.models.glob("*.xml"))
    }
    real = {name: mapper.arrays(config) for name, config in configs.items()}
    unseen = report_arms(mapper.env)[UNSEEN]
    random = {name: arm for name, arm in unseen.items() if name.startswith("random")}
    groups = groups_of_pairs(mapper, real, random)
    pairs = [pair for of_group in groups.values() for pair in of_group]
    arms = {ENV: mapper.own_expert.arrays, **real, **random}
    experts, learners = ([arms[pair[role]] for pair in pairs] for role in range(2))
    metrics = evaluate(mapper, experts, learners, options.poses)
    rows = [
        {"expert": expert, "learner": learner, **row} for (expert, learner), row in zip(pairs, metrics, strict=True)
    ]
    kept = iter(rows)
    summaries = [summary(group, list(itertools.islice(kept, len(names)))) for group, names in groups.items()]
    report = read_json(options.run / REPORT)
    run = {key: report[key] for key in ("env", "seed", "training_poses", "wall_time_s", "hardware")}
    write_results(options, run=run, expert=mapper.env.expert.model, poses=options.poses, groups=summaries, pairs=rows)
    print_table(summaries, COLUMNS)


if __name__ == "__main__":
    main()
