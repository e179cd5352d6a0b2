"""Which metric makes a learner resemble the expert: measures that nothing optimises, at each candidate's optimum.

    python -m benchmarks.similarity --out FILE [--arms FOLDER] [--plot FILE.png] [--all] [--pair NAME]

For every pair of arms and set of expert poses, the learner takes the pose of minimum distance under each candidate
metric (links kept or merged, correspondence, translation weight beside a rotation weight of 1), and the five measures
of `mimic.metric.similarity` say how alike the arms look; beside them those of the baselines of
`mimic.retargeting.pose_baselines`.
FOLDER holds an unpacked wheel of robosuite, for arms other than the Panda; without it they are left out.

Poses are optimised as by `imitate_pose`, but all pairs share one compiled function: see `benchmarks.similarity_poses`.
Hard and soft correspondence, by `imitate_pose` itself, take most of the time and are run on a few pairs, unless --all.
"""

import argparse
import dataclasses
import functools
import itertools
import json
import logging
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import mimic
from benchmarks import similarity_summary
from benchmarks.record import write_results
from benchmarks.similarity_poses import arm_data, best_poses
from mimic.arms.arm import ArmConfig, build_arm
from mimic.arms.embodiment import Embodiment
from mimic.metric.config import MetricConfig
from mimic.metric.kinematics import link_state_table
from mimic.metric.similarity import CentreLine, centre_line_table, similarity
from mimic.retargeting.pose import shared_joints
from mimic.retargeting.pose_baselines import BASELINES

TRANSLATIONS = 0.0, 0.25, 0.5, 1.0, 2.0, 4.0  # with a rotation weight of 1
STATE_DEPENDENT = 0.0, 0.5, 2.0  # translation weights of hard and soft correspondence
MERGED = {"chord_overlap": (0.0,), "overlap": (0.0, 0.5, 2.0), "arc_length": (0.0, 0.5, 2.0)}
SUBSET = ("panda -3,6,7", "panda -5")  # of hard and soft, unless --all
FULL = "panda -3,6,7"  # the environment panda4dof: always on 40 demonstrations, every fifth sample
FULL_DEMONSTRATIONS, FULL_EVERY = 40, 5
ROBOSUITE = {
    "UR5e": "ur5e", "IIWA": "iiwa", "Kinova3": "kinova3", "Sawyer": "sawyer", "Jaco": "jaco", "xArm7": "xarm7",
}  # fmt: skip
WANTED = "UR10e", *ROBOSUITE


@dataclasses.dataclass(frozen=True)
class Pair:
    """Two arms.

    Attributes:
      name: "panda -3,6,7" for a Panda with joints locked, else "EXPERT to LEARNER".
      expert, learner: configs of the arms.
      locked: the Panda's locked joints, by number.
    """

    name: str
    expert: ArmConfig
    learner: ArmConfig
    locked: tuple[int, ...] = ()


def locked_pandas() -> list[Pair]:
    """All single and double locks, and two that the environments have."""
    locks = [lock for count in (1, 2) for lock in itertools.combinations(range(1, 8), count)]
    locks += [(3, 6, 7), (2, 3, 6, 7)]
    return [Pair(f"panda -{','.join(map(str, x))}", ArmConfig(), ArmConfig(locked=list(x)), x) for x in locks]


def other_arms(folder: Path | None) -> tuple[list[Pair], list[str]]:
    """Pairs of the Panda with arms in a folder, both directions, and the arms that were not found."""
    files = {
        name: (folder or Path()) / f"robosuite/models/assets/robots/{arm}/robot.xml" for name, arm in ROBOSUITE.items()
    }
    found = {name: file for name, file in files.items() if folder is not None and file.is_file()}
    pairs = []
    for name, file in found.items():
        arm = ArmConfig(model=str(file), tip="right_hand", armature=0.3, damping=3.0)  # as docs/own_arm.md proposes
        pairs += [Pair(f"panda to {name}", ArmConfig(), arm), Pair(f"{name} to panda", arm, ArmConfig())]
    return pairs, [name for name in WANTED if name not in found]


@functools.lru_cache(maxsize=8)
def expert_motions(model: str, tip: str | None, count: int, random: int) -> dict[str, Any]:
    """Motions [count, time, n] of an expert by kind; a string that says why where there are none."""
    config = ArmConfig() if model == "panda" else ArmConfig(model=model, tip=tip, armature=0.3, damping=3.0)
    arm = build_arm(config)
    lower, upper = np.asarray(arm.embodiment.joint_range).T
    shape = (random, 1, arm.embodiment.num_joints)
    motions: dict[str, Any] = {"random": np.random.default_rng(0).uniform(lower, upper, shape)}
    for kind in ("pd", "reach"):
        try:
            motions[kind] = mimic.record_demonstrations(arm, count, kind=kind).qpos
        except ValueError as error:
            motions[kind] = str(error)
    return motions


def optimal_poses(
    expert: Embodiment, pair: Pair, links: str, correspondence: str, translations: tuple[float, ...], qpos: np.ndarray
) -> Iterator[tuple[float, Embodiment, np.ndarray]]:
    """For each translation weight, the arm that was optimised and its poses."""
    learner = build_arm(pair.learner, links=links).embodiment
    own = shared_joints(expert, learner, qpos.astype(np.float32))
    metric = MetricConfig(correspondence=correspondence, links=links)
    matrix = metric.make_correspondence(expert, learner)
    if callable(matrix):
        yield from _state_dependent(expert, learner, matrix, translations, qpos)
        return
    data, states = arm_data(learner), link_state_table(expert, qpos, np.zeros_like(qpos))
    for translation in translations:
        found = best_poses(data, states, matrix, translation, own)
        yield translation, learner, found[:, : learner.num_joints]


def _state_dependent(
    expert: Embodiment, learner: Embodiment, correspondence: Any, translations: tuple[float, ...], qpos: np.ndarray
) -> Iterator[tuple[float, Embodiment, np.ndarray]]:
    """By `imitate_pose`, compiled once for all weights."""

    @jax.jit
    def solve(qpos: jax.Array, translation: jax.Array) -> jax.Array:
        weights = mimic.DistanceWeights(translation, 1.0)
        return mimic.imitate_pose(expert, learner, qpos, correspondence, weights).qpos

    for translation in translations:
        yield translation, learner, np.asarray(solve(jnp.asarray(qpos, jnp.float32), jnp.float32(translation)))


def measured(expert_line: CentreLine, learner: Embodiment, qpos: np.ndarray) -> dict[str, list[float]]:
    """Mean and 90 % quantile of each measure."""
    values = similarity(expert_line, centre_line_table(learner, qpos))
    return {name: [round(float(x), 5) for x in (v.mean(), np.quantile(v, 0.9))] for name, v in values.items()}


def run_pair(pair: Pair, options: argparse.Namespace) -> list[dict[str, Any]]:
    """All baselines and candidates on all sets of poses."""
    expert, learner = build_arm(pair.expert).embodiment, build_arm(pair.learner).embodiment
    model = pair.expert.model
    is_full = pair.name == FULL
    count = max(FULL_DEMONSTRATIONS, options.demonstrations) if is_full else options.demonstrations
    every = min(FULL_EVERY, options.every) if is_full else options.every
    motions = expert_motions(model, pair.expert.tip, count, options.random)
    rows = []
    for name, motion in motions.items():
        if isinstance(motion, str):
            rows.append({"pair": pair.name, "set": name, "failed": motion})
            continue
        qpos = motion[:, ::every].reshape(-1, expert.num_joints)
        line = centre_line_table(expert, qpos)
        here = {"pair": pair.name, "set": name, "poses": len(qpos)}
        for baseline, function in BASELINES.items():
            posed = function(expert, learner, motion)
            if posed is not None:
                taken = posed[:, ::every].reshape(-1, learner.num_joints)
                rows.append({**here, "method": baseline, "measures": measured(line, learner, taken)})
        for links, correspondence, translations in candidates(pair, options.all):
            for translation, arm, found in optimal_poses(expert, pair, links, correspondence, translations, qpos):
                candidate = f"{links} {correspondence} {translation:g}"
                rows.append({**here, "method": candidate, "measures": measured(line, arm, found)})
    return rows


def candidates(pair: Pair, everything: bool) -> Iterator[tuple[str, str, tuple[float, ...]]]:
    """Links, correspondence and translation weights."""
    for correspondence in ("arc_length", "overlap"):
        yield "kept", correspondence, TRANSLATIONS
    if pair.locked:  # nothing is merged where nothing is locked
        for correspondence, translations in MERGED.items():
            yield "merged", correspondence, translations
    if everything or pair.name in SUBSET:
        for correspondence in ("hard", "soft"):
            yield "kept", correspondence, STATE_DEPENDENT


def _rows_so_far(path: Path, settings: dict[str, Any]) -> list[dict[str, Any]]:
    """Of a file of results; exits where it was made with other settings."""
    if not path.is_file():
        return []
    content = json.loads(path.read_text())
    if content["settings"] != settings:
        sys.exit(f"error: {path} was made with {content['settings']}, not with {settings}")
    return similarity_summary.from_lines(content["rows"])


def main() -> None:
    """Runs all pairs, and writes the file after each."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.similarity", description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--out", type=Path, required=True, help="file of results")
    parser.add_argument("--arms", type=Path, help="folder of an unpacked robosuite wheel")
    parser.add_argument("--plot", type=Path, help="picture of the Pareto front")
    parser.add_argument("--pair", action="append", help="only this one (may be repeated)")
    parser.add_argument("--demonstrations", type=int, default=20, help="of each kind")
    parser.add_argument("--every", type=int, default=10, help="samples of a demonstration of which one is taken")
    parser.add_argument("--random", type=int, default=120, help="random poses")
    parser.add_argument("--all", action="store_true", help="hard and soft on all pairs")
    parser.add_argument("--resume", action="store_true", help="keep the pairs that the file of results has")
    parser.add_argument("--commit", help="what the results are of, where this is no git checkout")
    options = parser.parse_args()
    logging.getLogger("mimic").setLevel(logging.ERROR)
    others, missing = other_arms(options.arms)
    pairs = [*locked_pandas(), *others]
    unknown = set(options.pair or ()) - {pair.name for pair in pairs}
    if unknown:
        sys.exit(f"error: unknown pair {min(unknown)!r}; valid are {', '.join(pair.name for pair in pairs)}")
    settings = {name: getattr(options, name) for name in ("demonstrations", "every", "random", "all")}
    rows = _rows_so_far(options.out, settings) if options.resume else []
    measured_pairs = {row["pair"] for row in rows}
    for pair in pairs:
        if (options.pair and pair.name not in options.pair) or pair.name in measured_pairs:
            continue
        began = time.perf_counter()
        rows += run_pair(pair, options)
        print(f"{pair.name}: {time.perf_counter() - began:.0f} s", flush=True)
        summary = similarity_summary.summarise(rows)
        content = {
            "settings": settings,
            "not_found": missing,
            "summary": summary,
            "rows": similarity_summary.to_lines(rows),
        }
        write_results(options.out, "similarity", options.commit, **content)
    similarity_summary.print_tables(rows)
    if options.plot:
        similarity_summary.save_plot(rows, options.plot)


if __name__ == "__main__":
    main()
