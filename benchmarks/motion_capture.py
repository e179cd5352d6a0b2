"""Similarity of robots to the arms of captured people: mimic's motions, and baselines, by measures nobody optimises.

    python -m benchmarks.motion_capture CLIP.bvh ... --out FILE [--rate 20] [--arms FOLDER]

Each arm of each clip is retargeted to the Panda, with and without locked joints, and to arms of an unpacked wheel of
robosuite in FOLDER. Methods: `imitate_trajectory` with angles and positions of links that are cut alike, without and
with the cost of the hand, and with the default metric; a pose mapper that was trained on the poses of the same arm of
the clip, with the metric of the first; inverse kinematics of the scaled hand by mink, and of frames of the links as GMR
does it. Besides the measures of similarity: the largest speed of a joint between two samples
[rad/s], and the root mean square of the joints' jerk [rad/s^3], at the captured speed.
"""

import dataclasses
import itertools
import tempfile
from collections.abc import Callable
from pathlib import Path

import jax.numpy as jnp
import numpy as np

import mimic
from benchmarks.common.cut_links import cut_alike
from benchmarks.common.parser import make_parser
from benchmarks.common.record import Row, print_table, write_results
from benchmarks.peers.frame_matching import match_frames
from benchmarks.peers.landmarks import Landmarks
from benchmarks.similarity import other_arms
from mimic.arms.arm import ArmConfig
from mimic.commands.capture import fixed_fraction, read_arm
from mimic.commands.config import CaptureConfig
from mimic.envs.config import EnvConfig
from mimic.metric.config import MetricConfig
from mimic.metric.similarity import centre_line_table, similarity
from mimic.motions.mocap.ball_chain import ball_chain_motion, ball_chain_xml, zero_frames
from mimic.motions.mocap.link_motion import TRUNK, LinkMotion
from mimic.motions.mocap.points import SIDES
from mimic.retargeting.pose_baselines import hand_ik
from mimic.runs.signals import Signals
from mimic.trainers.config import PoseMapperConfig
from mimic.trainers.pose_mapper.model import MapperModel
from mimic.trainers.pose_mapper.training import train

_SPEED = 15.0  # rad/s, of a joint: retargeting passes from one minimum to another within it
# Angles, because they and positions are linear near a match, and cosines are not. See docs/motion_capture.md for the
# weight of positions.
METRIC = MetricConfig(rotation_measure="angle", translation=2.0)
HAND = mimic.Costs(hand_position=300.0)
_MAPPER = PoseMapperConfig(fresh=False, samples=256, batch_size=64, epochs=400, evaluations=1, validation_poses=64)


def learners(folder: Path | None) -> dict[str, ArmConfig]:
    """Robots by name."""
    arms = {f"panda -{lock}": ArmConfig(locked=[lock]) for lock in (3, 6, 7)}
    arms = {"panda": ArmConfig(), "panda -3,6,7": ArmConfig(locked=[3, 6, 7]), **arms}
    if folder:
        others = {pair.name.removeprefix("panda to "): pair.learner for pair in other_arms(folder)[0][::2]}
        arms |= {name: config for name, config in others.items() if name in ("UR5e", "IIWA")}
    return arms


@dataclasses.dataclass(frozen=True)
class Case:
    """A captured motion and a robot.

    Attributes:
      expert, learner: the person's arm, and the robot.
      qpos: [time, joints] the person's poses [rad].
      marks: shoulder, elbow, wrist and hand of the person.
      rate: samples per second.
    """

    expert: mimic.Embodiment
    learner: mimic.Embodiment
    qpos: np.ndarray
    marks: Landmarks
    rate: float


def read_case(clip: Path, side: str, name: str, config: ArmConfig, rate: float) -> Case:
    """The longest part of a clip without gaps, at about a rate [1/s]: a whole fraction of that of the clip."""
    learner = EnvConfig(name, learner=config).build_arms().learner.embodiment
    capture = read_arm(clip, side, CaptureConfig(), fixed_fraction(learner))
    part = max(capture.parts, key=lambda part: len(part.start))
    every = max(1, round(part.rate / rate))
    with tempfile.TemporaryDirectory() as folder:
        expert, qpos = _as_arm(part, Path(folder) / "person.xml", every)
    shoulder = int(TRUNK in part.names)
    marks = Landmarks(shoulder, shoulder + 1, shoulder + 2, len(part.names))
    return Case(expert, learner, qpos, marks, part.rate / every)


def imitated(case: Case, costs: mimic.Costs | None = None) -> np.ndarray:
    arguments = METRIC.build(case.expert, case.learner).arguments
    qpos, jump = jnp.asarray(case.qpos, jnp.float32), _SPEED / case.rate
    moved = mimic.imitate_trajectory(case.expert, case.learner, qpos, **arguments, largest_jump=jump, costs=costs)
    return np.asarray(moved.qpos)


def with_cut_links(case: Case) -> Case:
    expert, learner = cut_alike(case.expert, case.learner)
    return dataclasses.replace(case, expert=expert, learner=learner)


def mapped(case: Case) -> np.ndarray:
    """Poses of a mapper that was trained on the same poses."""
    settings = _MAPPER.resolve()
    model = MapperModel(EnvConfig(metric=METRIC), settings, case.expert, case.learner)
    shuffled = np.random.default_rng(0).permutation(len(case.qpos))
    poses = jnp.asarray(case.qpos[np.resize(shuffled, settings.samples)], jnp.float32)
    with tempfile.TemporaryDirectory() as folder:
        _, params = train(
            model,
            lambda: (poses, poses[: settings.validation_poses]),
            Path(folder),
            seed=0,
            on_evaluation=lambda *_: None,
            signals=Signals(),
        )
    return np.asarray(model.of_poses(params, jnp.asarray(case.qpos, jnp.float32)))


METHODS: dict[str, Callable[[Case], np.ndarray | None]] = {
    "mimic": lambda case: imitated(with_cut_links(case)),
    "mimic_hand": lambda case: imitated(with_cut_links(case), costs=HAND),
    "pose_mapper": lambda case: mapped(with_cut_links(case)),
    "hand_ik": lambda case: hand_ik(case.expert, case.learner, case.qpos, every=1),
    "frame_matching": lambda case: match_frames(case.expert, case.learner, case.qpos, case.marks),
}


def measure(case: Case) -> list[Row]:
    """Measures of each method that applies."""
    line, rows = centre_line_table(case.expert, case.qpos), []
    for method, imitate in METHODS.items():
        motion = imitate(case)
        if motion is not None:
            rows.append({"method": method, **_measures(line, case.learner, np.asarray(motion, float), case.rate)})
    return rows


def _as_arm(part: LinkMotion, path: Path, every: int) -> tuple[mimic.Embodiment, np.ndarray]:
    """The person's arm, and its poses at one of so many samples."""
    zero = zero_frames(part)
    path.write_text(ball_chain_xml(part, zero))
    return mimic.load_mjcf(path), ball_chain_motion(part, zero)[0][::every]


def _measures(line: object, learner: mimic.Embodiment, qpos: np.ndarray, rate: float) -> Row:
    values = similarity(line, centre_line_table(learner, qpos))  # type: ignore[arg-type]
    means = {name: float(np.mean(value)) for name, value in values.items()}
    jerk = np.diff(qpos, n=3, axis=0) * rate**3
    speed = rate * float(np.abs(np.diff(qpos, axis=0)).max())
    return {**means, "largest_speed": speed, "jerk_rms": float(np.sqrt((jerk**2).mean()))}


def main() -> None:
    parser = make_parser("motion_capture", __doc__, rate=20.0)
    parser.add_argument("clips", nargs="+", type=Path)
    parser.add_argument("--arms", type=Path, help="folder with an unpacked wheel of robosuite")
    options = parser.parse_args()
    rows: list[Row] = []
    for clip, (name, robot), side in itertools.product(options.clips, learners(options.arms).items(), SIDES):
        case = read_case(clip, side, name, robot, options.rate)
        names = {"clip": clip.name, "arm": side, "learner": name}
        rows += [{**names, **row} for row in measure(case)]
        print(f"{clip.name}, {side} arm to {name}", flush=True)
        write_results(options, rate=options.rate, results=rows)
    print_table(
        rows,
        "clip arm learner method centre_line_distance:.4f tangent_angle_deg:.1f hand_position_error:.4f "
        "hand_angle_deg:.1f largest_speed:.1f jerk_rms:.1f",
    )


if __name__ == "__main__":
    main()
