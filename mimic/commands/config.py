"""Configs of the commands; those of a training and of an export are in mimic/trainers.

This module imports other configs only, so that `--help` stays fast.
"""

import dataclasses
from typing import Any

from mimic.arms.arm import ArmConfig
from mimic.arms.embodiment import LIMITS
from mimic.base.config import check_choice, check_unused
from mimic.base.ranges import check_ranges, checkpoint_number, number, seed_number
from mimic.envs.config import EnvConfig
from mimic.evaluation.labels import SPLITS
from mimic.physics.world import PHYSICS
from mimic.retargeting.costs import Costs
from mimic.retargeting.hand_target import placement
from mimic.trainers.config import trainers

ROBOT_WORLDS = ("nominal", "hardware")
ROBOTS = ("virtual_panda", "virtual_robot")
ROBOT_LOOPS = ("mimic", "ruckig")
CONTROLLERS = (
    "policy", "hold", "copy_joints", "pd", "computed_torque", "one_step", "nearest_pose", "mpc", "tracking"
)  # fmt: skip
ROBOT_CONTROLLERS = ("policy", "tracking")
ARM_SIDES = ("left", "right")
DATASET_FORMATS = ("lerobot", "rosbag2")


def _check_locked(locked: list[Any], learner: str) -> None:
    """Raises a `ValueError` for locked joints without the arm that they belong to."""
    if locked and not learner:
        raise ValueError(f"locked: expected with learner=NAME, as in learner=panda locked=[2,4], got {locked}")


@dataclasses.dataclass(frozen=True)
class EvaluateConfig:
    """Config of an evaluation of a trained policy, or of another controller in its place.

    Attributes:
      run: run directory, or the environment of a policy that comes with mimic.
      checkpoint: environment steps of the checkpoint. Default None: the last checkpoint.
      controller: "policy", or a baseline controller (see `run_controller`).
      learner: of a run of many arms: name or file of the one arm to evaluate on. Default "": all arms of the report.
      locked: numbers or names of the joints of `learner` that are locked.
      demonstrations: file of demonstrations that replace the held-out ones; episodes have their length.
      split: "test": the test set replaces the held-out demonstrations, see `test_demonstrations`. Default "": none.
      physics: see `EnvConfig`. Default "": that of the run.
      robot: "virtual_panda": the policy, or "tracking", controls virtual Pandas in C MuJoCo, which abort as real ones
        do; "virtual_robot": the same for another learner. Default "": the environment of the run.
      episodes: number of episodes of `robot`, of each case with `edges`.
      robot_world: preset of the world of `robot`: "nominal" or "hardware". Default "": that of the run.
      robot_loop: control loop of `robot`: "mimic", the one of training, or "ruckig", online trajectories as those of
        franky-control.
      edges: whether there are also cases with each range of the world at its ends.
      seed: of what is drawn for each episode of `robot`.
      out: new folder for report, table and plots. Default "": the report is printed only.
      compilation_cache: see `TrainConfig`.
    """

    run: str = ""
    checkpoint: int | None = checkpoint_number()
    controller: str = "policy"
    learner: str = ""
    locked: list[Any] = dataclasses.field(default_factory=list)
    demonstrations: str = ""
    split: str = ""
    physics: str = ""
    robot: str = ""
    episodes: int = number(1000, at_least=1, at_most=10_000_000)
    robot_world: str = ""
    robot_loop: str = "mimic"
    edges: bool = False
    seed: int = number(0, at_least=0, at_most=2**31 - 1)
    out: str = ""
    compilation_cache: str = "~/.cache/mimic/jax"

    def __post_init__(self) -> None:
        check_ranges(self)
        check_choice("controller", self.controller, CONTROLLERS)
        self._check_robot()
        _check_locked(self.locked, self.learner)
        if self.split:
            check_choice("split", self.split, ("test",))
            if self.demonstrations or self.robot:
                raise ValueError("split, demonstrations, robot: expected one of them, got several")
        if self.physics:
            check_choice("physics", self.physics, PHYSICS)

    def _check_robot(self) -> None:
        """Raises a `ValueError` for options of another kind of evaluation."""
        if not self.robot:
            keys = "episodes", "robot_world", "robot_loop", "edges", "seed"
            check_unused(self, keys, "without robot=, as in robot=virtual_panda")
            return
        check_choice("robot", self.robot, ROBOTS)
        check_choice("robot_loop", self.robot_loop, ROBOT_LOOPS)
        if self.robot_world:
            check_choice("robot_world", self.robot_world, ROBOT_WORLDS)
        if self.controller not in ROBOT_CONTROLLERS:
            raise ValueError(
                f"controller: expected {' or '.join(ROBOT_CONTROLLERS)} with robot=, got {self.controller}"
            )
        check_unused(self, ("learner", "physics"), "with robot=, whose physics are C MuJoCo's")


@dataclasses.dataclass(frozen=True)
class RenderConfig:
    """Config of a video of a trained policy, or of retargeted motions.

    Attributes:
      run: run directory of a policy, or the environment of one that comes with mimic.
      checkpoint: steps of the checkpoint. Default None: the last checkpoint.
      split: "held_out" or "train": demonstrations of a policy's run.
      demonstration: index from 0 into the split, or of the episode of the data set.
      retargeted: folder of the data set that `mimic.retarget` wrote.
      expert: its expert: name or file of an arm, or an environment that has it.
      learner: its learner, in the same way; of a run of many arms, name or file of the arm.
      locked: numbers or names of the joints of this arm that are locked; of a run of many arms.
      limits: the `limits` that `retargeted` was computed with.
      out: video file. Default "": a file in the folder `videos` of the run directory, or in the
        current folder where there is none.
      compilation_cache: see `TrainConfig`.
    """

    run: str = ""
    checkpoint: int | None = checkpoint_number()
    split: str = "held_out"
    demonstration: int = number(0, at_least=0, at_most=1_000_000)
    retargeted: str = ""
    learner: str = ""
    locked: list[Any] = dataclasses.field(default_factory=list)
    expert: str = ""
    limits: str = "none"
    out: str = ""
    compilation_cache: str = "~/.cache/mimic/jax"

    def __post_init__(self) -> None:
        check_ranges(self)
        check_choice("split", self.split, SPLITS)
        _check_locked(self.locked, self.learner)


@dataclasses.dataclass(frozen=True)
class DatasetConfig:
    """Config of a dataset of rollouts of a policy, or of motions from files.

    Attributes:
      run: run directory of a policy, or the environment of one that comes with mimic.
      checkpoint: steps of the checkpoint. Default None: the last checkpoint.
      split: "held_out" or "train": demonstrations of the run to roll the policy out on. Default "": both.
      demonstrations: file of motions to write instead of rollouts.
      format: "lerobot" or "rosbag2".
      task: what the robot does, in words. Default "": made of the names of environment and arms.
      out: folder of the dataset; must not exist.
      compilation_cache: see `TrainConfig`.
    """

    run: str = ""
    checkpoint: int | None = checkpoint_number()
    split: str = ""
    demonstrations: str = ""
    format: str = "lerobot"
    task: str = ""
    out: str = ""
    compilation_cache: str = "~/.cache/mimic/jax"

    def __post_init__(self) -> None:
        check_ranges(self)
        check_choice("format", self.format, DATASET_FORMATS)
        if self.split:
            check_choice("split", self.split, SPLITS)


@dataclasses.dataclass(frozen=True)
class CollectConfig:
    """Config of a collection of runs.

    Attributes:
      folder: folder that contains the run directories, at any depth.
      out: folder for the table, the plot and the JSON file. Default "": `folder`.
      only: name of a trainer: only its runs are collected. Default "": all runs must have the same trainer.
    """

    folder: str = ""
    out: str = ""
    only: str = ""

    def __post_init__(self) -> None:
        if self.only:
            check_choice("only", self.only, trainers())


@dataclasses.dataclass(frozen=True)
class CaptureConfig:
    """How a motion capture file is read and cut into demonstrations.

    Attributes:
      unit: of the file, see `read_motion`. Default "": found out.
      up: axis of the file that points up, see `read_motion`. Default "": found out.
      subject: person to read where a file has several, see `read_motion`. Default "": the first.
      shoulder, elbow, wrist, hand: points of the arm, as in `STYLr+STYLu` for the middle of two. Default "": found by
        their names.
      yaw, pitch, roll: turn the person about z, then y, then x of the robot's base [deg]. By default up is up, and
        forward is the x-axis of the robot's base.
      trunk: length of an upright link below the shoulder [m], where the base frame then is; 0 for none. Default None:
        as large a part of the chain as the learner's links that stand still, such as the column of a Panda.
      cutoff: of the low-pass filter [Hz].
      speed: maximum speed of a link relative to the one before [rad/s]; faster motions are slowed down.
      slow_down: factor on times. Default None: as large as `speed` requires.
      overlap: fraction of a window that it has in common with the next.
      held_out: fraction of the windows that is held out, the last in time.
    """

    unit: str = ""
    up: str = ""
    subject: str = ""
    shoulder: str = ""
    elbow: str = ""
    wrist: str = ""
    hand: str = ""
    yaw: float = number(0.0, at_least=-360.0, at_most=360.0)
    pitch: float = number(0.0, at_least=-360.0, at_most=360.0)
    roll: float = number(0.0, at_least=-360.0, at_most=360.0)
    trunk: float | None = number(None, at_least=0.0, at_most=10.0)
    cutoff: float = number(6.0, at_least=0.1, at_most=1e4)
    speed: float = number(2.0, at_least=0.01, at_most=100.0)
    slow_down: float | None = number(None, at_least=0.1, at_most=100.0)
    overlap: float = number(0.9, at_least=0.0, at_most=0.95)
    held_out: float = number(0.2, at_least=0.01, at_most=0.9)

    def __post_init__(self) -> None:
        check_ranges(self, "capture.")


@dataclasses.dataclass(frozen=True)
class RecordingConfig:
    """Config of a recording of demonstrations.

    Attributes:
      env: environment whose expert is recorded, with its control step.
      kind, count, seed: see `DemonstrationConfig`. Default None: those of the environment.
      limits: see `EnvConfig`. Default None: those of the environment.
      source: file or folder of motions to import instead of recording, see `import_demonstrations`.
      joints: names of the expert's joints in `source`, base to tip. Default []: the expert's own names.
      topic: topic or feature of `source` that has the joints, where several do; see `import_demonstrations`.
      units: of the angles in `source`: rad, deg or percent. Default "": stated there or found, see
        `import_demonstrations`.
      rate: samples per second of a table or of HDF5 files in `source`. Default None: stated there.
      arm: "left" or "right" arm of the person in a motion capture file `source`, or "both". Default "": right.
      capture: how such a file is read and cut.
      out: .npz file of the demonstrations, with the plot beside it as .png; neither may exist.
    """

    env: EnvConfig = dataclasses.field(default_factory=EnvConfig)
    kind: str | None = None
    count: int | None = number(None, at_least=1, at_most=100_000)
    seed: int | None = number(None, at_least=0, at_most=2**63 - 1)
    limits: str | None = None
    source: str = ""
    joints: list[str] = dataclasses.field(default_factory=list)
    topic: str = ""
    units: str = ""
    rate: float | None = number(None, at_least=0.1, at_most=1e5)
    arm: str = ""
    capture: CaptureConfig = dataclasses.field(default_factory=CaptureConfig)
    out: str = ""

    def __post_init__(self) -> None:
        check_ranges(self)

    def resolve(self) -> EnvConfig:
        """Returns the environment with the values set in this config.

        Raises:
          ValueError: a value is invalid.
        """
        settings = {name: getattr(self, name) for name in ("kind", "count", "seed")}
        demonstrations = dataclasses.replace(self.env.demonstrations, **_without_none(settings))
        return dataclasses.replace(self.env, demonstrations=demonstrations, **_without_none({"limits": self.limits}))


@dataclasses.dataclass(frozen=True)
class InspectConfig:
    """Config of an inspection of a learner before training.

    Attributes:
      learner: arm to inspect.
      expert: arm that it should imitate.
      limits: see `EnvConfig`.
      bound: whether to compute the kinematic bound of the distance and what the hand keeps, which takes a minute.
      base: "same" for the learner's base where the expert's is, "auto" for where most of the expert's range is exact,
        or [x,y,z,yaw] in the expert's base frame [m, rad].
      out: new folder for a picture of both arms with their correspondence and their reach, and a JSON file of all
        results.
      clip: motion capture file to inspect instead of an arm.
      capture: how it is read.
    """

    learner: ArmConfig = dataclasses.field(default_factory=ArmConfig)
    expert: ArmConfig = dataclasses.field(default_factory=ArmConfig)
    limits: str = "none"
    bound: bool = True
    base: Any = "same"
    out: str = ""
    clip: str = ""
    capture: CaptureConfig = dataclasses.field(default_factory=CaptureConfig)

    def __post_init__(self) -> None:
        check_choice("limits", self.limits, LIMITS)
        _ = base_numbers(self.base)
        if self.clip:
            check_unused(self, ("out", "base"), "with clip=, whose arms `mimic.view source=` shows")
        else:
            check_unused(self, ("capture",), "without clip=FILE")
        if self.base != "same" and not self.bound:
            raise ValueError("base: expected none with bound=false, which compares no hands")


_HANDS, _FAILING = ("exact", "near", "scaled"), ("left_out", "kept")
_BASE = "x", "y", "z", "yaw"


def base_numbers(base: Any) -> list[float] | None:
    """The learner's base in the expert's base frame, [x, y, z, yaw] [m, rad]; None for the same or one to find.

    Raises:
      ValueError: the value of the key `base` is nothing of the kind.
    """
    if isinstance(base, list | tuple) and len(base) == len(_BASE) and all(isinstance(x, int | float) for x in base):
        placement(base)
        return [float(number) for number in base]
    if base in ("same", "auto"):
        return None
    raise ValueError(f"base: expected same, auto or [{','.join(_BASE)}], got {base!r}")


@dataclasses.dataclass(frozen=True)
class RetargetConfig:
    """Config of a retargeting of a data set, or of demonstrations.

    Attributes:
      source: data set of the expert to write again as one of the learner, see `import_demonstrations` for formats; or a
        file of demonstrations.
      hand: "exact" for the expert's hand in metres, which each frame must keep; "near" for the nearest
        one within the limits; "scaled" for the pose that resembles the expert's, in chain lengths.
      base: "same" for the learner's base where the expert's is, "auto" for where most frames are exact,
        or [x,y,z,yaw] in the expert's base frame [m, rad].
      failing: what becomes of episodes that fail, "left_out" or "kept".
      joints, topic, units, rate: see `RecordingConfig`.
      env: environment that defines the arms and the metric.
      limits: see `EnvConfig`. Default None: those of the models.
      out: folder of the learner's data set; must not exist.
      costs: see `Costs`.
      seed: seed of the random initial poses.
      compilation_cache: see `TrainConfig`.
    """

    source: str = ""
    hand: str = "exact"
    base: Any = "same"
    failing: str = "left_out"
    joints: list[str] = dataclasses.field(default_factory=list)
    topic: str = ""
    units: str = ""
    rate: float | None = number(None, at_least=0.1, at_most=1e5)
    env: EnvConfig = dataclasses.field(default_factory=EnvConfig)
    limits: str | None = None
    out: str = ""
    costs: Costs = dataclasses.field(default_factory=Costs)
    seed: int = seed_number()
    compilation_cache: str = "~/.cache/mimic/jax"

    def __post_init__(self) -> None:
        check_ranges(self)
        check_choice("hand", self.hand, _HANDS)
        check_choice("failing", self.failing, _FAILING)
        base_numbers(self.base)

    def resolve(self) -> EnvConfig:
        """Returns the environment with the limits set in this config."""
        return dataclasses.replace(self.env, limits=self.limits or "hardware")


_FOLLOWED = "free", "exact", "relative"


@dataclasses.dataclass(frozen=True)
class ViewConfig:
    """Config of a live view of two arms.

    Attributes:
      env: environment that defines the arms and the metric.
      mapper: pose mapper that moves the learner instead of the optimiser: a run directory, or the environment
        of one that comes with mimic. Its arms are used.
      run: the same of a policy to play. Its arms and demonstrations are used.
      source: motion capture file of a person to play as the expert, or tcp://localhost:PORT, a socket of this machine
        that takes points as lines of JSON.
      demonstrations: file of the expert's demonstrations to choose from. Default "": random ones are recorded.
      hand: how the learner's hand follows the expert's at the start: "free", "exact" or "relative", see `HandSettings`.
      base: where the learner's base then stands, see `base_numbers`.
      record: new folder for what the hand drives, a LeRobot data set, written at the end. Default "": none.
      arm: "left" or "right" arm of the person in `source`. Default "": right.
      capture: how `source` is read.
      checkpoint: steps of the checkpoint of the policy or the mapper. Default None: the last checkpoint.
      split: "held_out" or "train": demonstrations of the run to show first.
      host: address of the server; 0.0.0.0 is every address of this machine.
      port: port of the server.
      compilation_cache: see `TrainConfig`.
    """

    env: EnvConfig = dataclasses.field(default_factory=EnvConfig)
    mapper: str = ""
    run: str = ""
    source: str = ""
    demonstrations: str = ""
    hand: str = "free"
    base: Any = "same"
    record: str = ""
    arm: str = ""
    capture: CaptureConfig = dataclasses.field(default_factory=CaptureConfig)
    checkpoint: int | None = checkpoint_number()
    split: str = "held_out"
    host: str = "127.0.0.1"
    port: int = number(8080, at_least=1, at_most=65_535)
    compilation_cache: str = "~/.cache/mimic/jax"

    def __post_init__(self) -> None:
        check_ranges(self)
        check_choice("split", self.split, SPLITS)
        if self.run and self.mapper:
            raise ValueError(f"run, mapper: expected one of them, got {self.run!r} and {self.mapper!r}")
        if self.source:
            check_unused(self, ("run", "mapper", "demonstrations"), "with source=, whose person is the expert")
        else:
            check_unused(self, ("arm", "capture"), "without source=")
        if self.arm:
            check_choice("arm", self.arm, ARM_SIDES)
        if self.run:
            check_unused(self, ("demonstrations",), "with run=, whose motions are shown")
        check_choice("hand", self.hand, _FOLLOWED)
        if self.run or self.mapper:
            check_unused(self, ("hand", "record"), "with run= or mapper=, which move the learner")
        if self.base != "same" and (self.hand == "free" or base_numbers(self.base) is None):
            raise ValueError(
                "base: expected same or [x,y,z,yaw] with hand=exact or relative; inspect base=auto finds one"
            )


def _without_none(values: dict[str, Any]) -> dict[str, Any]:
    return {name: value for name, value in values.items() if value is not None}
