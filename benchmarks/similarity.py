"""Similarity of the learner to the expert at the optimum of each candidate metric, by measures that nothing optimises.

    python -m benchmarks.similarity --out FILE [--arms FOLDER] [--plot FILE.png] [--hands]

The learner takes the pose of minimum distance under each candidate metric (links kept or merged, correspondence,
translation weight; the rotation weight is 1); with --hands under the default metric with each weight of the hand's
rotation, where elbow, wrist and the plane of shoulder, elbow and wrist are compared too. Baselines are those of
`mimic.retargeting.pose_baselines`. FOLDER holds an unpacked wheel of robosuite, for arms other than the Panda. Each
pair, links and correspondence compiles for 10 s.
"""

import dataclasses
import itertools
import logging
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import mimic
from benchmarks.common.parser import make_parser
from benchmarks.common.record import Row, write_results
from benchmarks.exact_hands import posture
from benchmarks.figures import similarity_front
from mimic.arms.arm import ArmConfig, build_arm
from mimic.envs.config import EnvConfig
from mimic.metric.config import MetricConfig
from mimic.metric.similarity import centre_line_table, similarity
from mimic.retargeting.pose_baselines import BASELINES

TRANSLATIONS = 0.0, 0.25, 0.5, 1.0, 2.0, 4.0  # weights; that of rotation is 1
SOME_TRANSLATIONS = 0.0, 0.5, 2.0
KEPT = {("kept", name): TRANSLATIONS for name in ("arc_length", "overlap")}  # candidates
MERGED = {("merged", name): SOME_TRANSLATIONS for name in ("overlap", "arc_length")}
HANDS = 0.0, 0.005, 0.01, 0.02, 0.05, 0.1, 0.3  # weights of the hand's rotation
EVERY = 10  # samples of a demonstration of which one is taken
FULL, FULL_DEMONSTRATIONS = "panda -3,6,7", 40  # the environment panda4dof: on more demonstrations and samples
ROBOSUITE = ("UR10e", "UR5e", "IIWA", "Kinova3", "Sawyer", "Jaco", "xArm7")


def locked_pandas() -> list[EnvConfig]:
    """All single and double locks, and two of the environments."""
    locks = [lock for count in (1, 2) for lock in itertools.combinations(range(1, 8), count)]
    locks += [(3, 6, 7), (2, 3, 6, 7)]
    return [EnvConfig(f"panda -{','.join(map(str, x))}", learner=ArmConfig(locked=list(x))) for x in locks]


def other_arms(folder: Path) -> tuple[list[EnvConfig], list[str]]:
    """Pairs of the Panda with arms in a folder, both directions, and the names of arms that are not in it."""
    files = {name: folder / f"robosuite/models/assets/robots/{name.lower()}/robot.xml" for name in ROBOSUITE}
    pairs = []
    for name in (name for name, file in files.items() if file.is_file()):
        arm = ArmConfig(str(files[name]), tip="right_hand", armature=0.3, damping=3.0)  # as docs/own_arm.md proposes
        pairs += [EnvConfig(f"panda to {name}", learner=arm), EnvConfig(f"{name} to panda", expert=arm)]
    return pairs, [name for name, file in files.items() if not file.is_file()]


def expert_motions(config: ArmConfig, count: int) -> dict[str, Any]:
    """Motions [count, time, n] of an expert by kind; instead of motions that cannot be recorded, the reason."""
    arm = build_arm(config)
    motions: dict[str, Any] = {}
    for kind in similarity_front.DEMONSTRATIONS:
        try:
            motions[kind] = mimic.record_demonstrations(arm, count, kind=kind).qpos
        except ValueError as error:
            motions[kind] = str(error)
    return motions


def optimal_poses(
    pair: EnvConfig, links: str, correspondence: str, translations: tuple[float, ...], qpos: np.ndarray
) -> Iterator[tuple[str, mimic.Embodiment, np.ndarray]]:
    """Name, learner and its poses for each translation weight; compiled once for all weights."""
    pair = dataclasses.replace(pair, metric=MetricConfig(correspondence=correspondence, links=links))
    expert, learner = pair.build_arms().embodiments
    matrix = pair.metric.make_correspondence(expert, learner)

    @jax.jit
    def solve(qpos: jax.Array, translation: jax.Array) -> jax.Array:
        weights = mimic.DistanceWeights(translation, 1.0)  # type: ignore[arg-type]
        return mimic.imitate_pose(expert, learner, qpos, matrix, weights).qpos

    for translation in translations:
        poses = np.asarray(solve(jnp.asarray(qpos, jnp.float32), jnp.float32(translation)))
        yield f"{links} {correspondence} {translation:g}", learner, poses


def with_hands(pair: EnvConfig, qpos: np.ndarray) -> Iterator[tuple[str, mimic.Embodiment, np.ndarray]]:
    """As `optimal_poses`, for each weight of the hand's rotation."""
    expert, learner = pair.build_arms().embodiments
    metric = pair.metric.build(expert, learner)

    @jax.jit
    def solve(qpos: jax.Array, rotation: jax.Array) -> jax.Array:
        weighted = dataclasses.replace(metric, hand_weights=mimic.HandWeights(rotation))
        return mimic.imitate_pose(expert, learner, qpos, **weighted.arguments).qpos

    for weight in HANDS:
        yield f"hand {weight:g}", learner, np.asarray(solve(jnp.asarray(qpos, jnp.float32), jnp.float32(weight)))


def with_locked(whole: mimic.Embodiment, arm: mimic.Embodiment, qpos: np.ndarray) -> np.ndarray:
    """Poses of an arm with its locked joints, which are at 0."""
    poses = np.zeros((len(qpos), whole.num_joints))
    poses[:, [whole.joint_names.index(name) for name in arm.joint_names]] = qpos
    return poses


def run_pair(pair: EnvConfig, demonstrations: int, *, hands: bool = False) -> list[Row]:
    expert, learner = pair.build_arms().embodiments
    count, every = (max(FULL_DEMONSTRATIONS, demonstrations), 5) if pair.name == FULL else (demonstrations, EVERY)
    rows: list[Row] = []
    motions = expert_motions(pair.expert, count)
    for kind in [kind for kind, motion in motions.items() if isinstance(motion, str)]:
        rows.append({"pair": pair.name, "set": kind, "failed": motions.pop(kind)})
    sets = {kind: motion[:, ::every].reshape(-1, expert.num_joints) for kind, motion in motions.items()}
    lines = {kind: centre_line_table(expert, qpos) for kind, qpos in sets.items()}
    whole = build_arm(dataclasses.replace(pair.learner, locked=[])).embodiment

    def add(method: str, kind: str, arm: mimic.Embodiment, qpos: np.ndarray) -> None:
        values = similarity(lines[kind], centre_line_table(arm, qpos))
        if hands:
            values |= posture(expert, whole, None, sets[kind], with_locked(whole, arm, qpos))
        means = {name: round(float(value.mean()), 5) for name, value in values.items()}
        rows.append({"pair": pair.name, "set": kind, "poses": len(qpos), "method": method, "measures": means})

    for (kind, motion), (baseline, function) in itertools.product(motions.items(), BASELINES.items()):
        posed = function(expert, learner, motion)
        if posed is not None:
            add(baseline, kind, learner, posed[:, ::every].reshape(-1, learner.num_joints))
    everything, ends = np.concatenate([*sets.values()]), np.cumsum([len(qpos) for qpos in sets.values()])
    if hands:
        for method, arm, poses in with_hands(pair, everything):
            for kind, part in zip(sets, np.split(poses, ends[:-1]), strict=True):
                add(method, kind, arm, part)
        return rows
    candidates = KEPT | (MERGED if pair.learner.locked else {})
    for (links, correspondence), translations in candidates.items():
        for method, arm, poses in optimal_poses(pair, links, correspondence, translations, everything):
            for kind, part in zip(sets, np.split(poses, ends[:-1]), strict=True):
                add(method, kind, arm, part)
    return rows


def main() -> None:
    parser = make_parser("similarity", __doc__, plot=Path, demonstrations=20, arms="robosuite")
    parser.add_argument("--hands", action="store_true", help="weights of the hand's rotation in the default metric")
    options = parser.parse_args()
    logging.getLogger("mimic").setLevel(logging.ERROR)
    others, missing = other_arms(Path(options.arms))
    settings = {"demonstrations": options.demonstrations, "every": EVERY}
    rows: list[Row] = []
    for pair in (*locked_pandas(), *others):
        rows += run_pair(pair, options.demonstrations, hands=options.hands)
        print(pair.name, flush=True)
        failed = [row for row in rows if "failed" in row]
        summary = similarity_front.summarise(rows)
        write_results(options, settings=settings, not_found=missing, summary=summary, failed=failed)
    similarity_front.print_tables(rows)
    if options.plot:
        (similarity_front.plot_hands if options.hands else similarity_front.plot)(rows, options.plot)


if __name__ == "__main__":
    main()
