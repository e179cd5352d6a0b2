"""Similarity of robots to the arms of captured people: mimic's motions, and baselines, by measures nobody optimises.

    python -m benchmarks.motion_capture CLIP.bvh ... --out FILE [--rate 50] [--arms FOLDER] [--trunks 0 0.25]

With `--trunks`, only the effect of the trunk's length [m] is measured instead: nearest poses of the Panda to 64 poses.

Each arm of each clip is retargeted to the Panda, with and without locked joints, and to arms of an unpacked wheel of
robosuite in FOLDER. Methods: `imitate_trajectory` with the default metric; inverse kinematics of the scaled hand by
mink; the closed form that aligns segments; holding the home pose. Beside the measures of similarity: the largest
change of a joint between two samples [rad], and the root mean square of the joints' jerk [rad/s^3], at the captured
speed.
"""

import tempfile
from pathlib import Path

import jax.numpy as jnp
import numpy as np

import mimic
from benchmarks.common.parser import make_parser
from benchmarks.common.record import Row, print_table, write_results
from benchmarks.similarity import other_arms
from mimic.arms.arm import ArmConfig
from mimic.commands.capture import fixed_fraction, read_arm
from mimic.commands.config import CaptureConfig
from mimic.envs.config import EnvConfig
from mimic.metric.similarity import centre_line_table, similarity
from mimic.mocap.arms import SIDES
from mimic.mocap.ball_chain import ball_chain_motion, ball_chain_xml, zero_frames
from mimic.mocap.link_motion import LinkMotion
from mimic.retargeting.pose_baselines import BASELINES

_POSES = 64  # of a clip, for the effect of the trunk


def learners(folder: Path | None) -> dict[str, ArmConfig]:
    """Robots by name."""
    arms = {f"panda -{lock}": ArmConfig(locked=[lock]) for lock in (3, 6, 7)}
    arms = {"panda": ArmConfig(), "panda -3,6,7": ArmConfig(locked=[3, 6, 7]), **arms}
    if folder:
        others = {pair.name.removeprefix("panda to "): pair.learner for pair in other_arms(folder)[0][::2]}
        arms |= {name: config for name, config in others.items() if name in ("UR5e", "IIWA")}
    return arms


def retarget(clip: Path, side: str, name: str, config: ArmConfig, rate: float) -> list[Row]:
    """Measures of each method for one arm of a clip and one robot."""
    learner_config = EnvConfig(name, learner=config)
    capture = read_arm(clip, side, CaptureConfig(), fixed_fraction(learner_config.build_arms().learner.embodiment))
    part = max(capture.parts, key=lambda part: len(part.start))
    with tempfile.TemporaryDirectory() as folder:
        expert, qpos = _as_arm(part, Path(folder) / "person.xml", rate)
    learner = learner_config.build_arms().learner.embodiment
    metric = learner_config.metric.build(expert, learner)
    moved = mimic.imitate_trajectory(expert, learner, jnp.asarray(qpos, jnp.float32), **metric.arguments)
    motions = {"mimic": np.asarray(moved.qpos, float)}
    for baseline, function in BASELINES.items():
        posed = function(expert, learner, qpos[None])
        if posed is not None:
            motions[baseline] = np.asarray(posed[0], float)
    line, case = centre_line_table(expert, qpos), {"clip": clip.name, "arm": side, "learner": name}
    return [{**case, "method": method, **_measures(line, learner, motion, rate)} for method, motion in motions.items()]


def nearest_with_trunk(clip: Path, side: str, trunk: float) -> Row:
    """Similarity of the Panda's nearest poses to some of a clip's, with a trunk of a length [m]."""
    part = max(read_arm(clip, side, CaptureConfig(trunk=trunk)).parts, key=lambda part: len(part.start))
    with tempfile.TemporaryDirectory() as folder:
        expert, qpos = _as_arm(part, Path(folder) / "person.xml", part.rate)
    qpos, learner = qpos[:: len(qpos) // _POSES][:_POSES], mimic.panda()
    metric = EnvConfig("trunk").metric.build(expert, learner)
    nearest = mimic.imitate_pose(expert, learner, jnp.asarray(qpos, jnp.float32), **metric.arguments)
    values = similarity(centre_line_table(expert, qpos), centre_line_table(learner, np.asarray(nearest.qpos, float)))
    means = {name: float(np.mean(value)) for name, value in values.items()}
    return {"clip": clip.name, "arm": side, "trunk_m": trunk, "distance": float(nearest.distance.mean()), **means}


def _as_arm(part: LinkMotion, path: Path, rate: float) -> tuple[mimic.Embodiment, np.ndarray]:
    """The person's arm and its poses at a rate [1/s]."""
    zero = zero_frames(part)
    path.write_text(ball_chain_xml(part, zero))
    every = max(1, round(part.rate / rate))
    return mimic.load_mjcf(path), ball_chain_motion(part, zero)[0][::every]


def _measures(line: object, learner: mimic.Embodiment, qpos: np.ndarray, rate: float) -> Row:
    values = similarity(line, centre_line_table(learner, qpos))  # type: ignore[arg-type]
    means = {name: float(np.mean(value)) for name, value in values.items()}
    jerk = np.diff(qpos, n=3, axis=0) * rate**3
    jump = float(np.abs(np.diff(qpos, axis=0)).max())
    return {**means, "largest_jump": jump, "jerk_rms": float(np.sqrt((jerk**2).mean()))}


def main() -> None:
    parser = make_parser("motion_capture", __doc__, rate=50.0)
    parser.add_argument("clips", nargs="+", type=Path)
    parser.add_argument("--trunks", nargs="+", type=float, metavar="M")
    parser.add_argument("--learners", nargs="+", metavar="NAME", help="some of the robots")
    parser.add_argument("--arms", type=Path, help="folder with an unpacked wheel of robosuite")
    options = parser.parse_args()
    rows: list[Row] = []
    if options.trunks:
        rows = [nearest_with_trunk(clip, "right", trunk) for clip in options.clips for trunk in options.trunks]
        write_results(options, results=rows)
        print_table(rows, "clip trunk_m:.2f distance:.4f centre_line_distance:.4f tangent_angle_deg:.1f")
        return
    robots = learners(options.arms)
    unknown = [name for name in options.learners or () if name not in robots]
    if unknown:
        parser.error(f"learners: expected some of {', '.join(robots)}, got {unknown[0]!r}")
    for clip in options.clips:
        for name in options.learners or robots:
            for side in SIDES:
                rows += retarget(clip, side, name, robots[name], options.rate)
                print(f"{clip.name}, {side} arm to {name}", flush=True)
            write_results(options, results=rows)
    print_table(
        rows,
        "clip arm learner method centre_line_distance:.4f tangent_angle_deg:.1f hand_position_error:.4f "
        "hand_angle_deg:.1f largest_jump:.2f jerk_rms:.1f",
    )


if __name__ == "__main__":
    main()
