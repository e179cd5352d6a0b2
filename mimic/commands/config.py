"""What each command is told beside the config of training, which is in mimic/trainers/config.py.

Imports configs alone: `--help` stays quick.
"""

import dataclasses
from pathlib import Path
from typing import Any

from mimic.arms.arm import ArmConfig
from mimic.arms.embodiment import LIMITS
from mimic.config import check_choice
from mimic.envs import env_config, environments
from mimic.envs.config import PHYSICS, EnvConfig
from mimic.evaluation.config import SearchConfig
from mimic.evaluation.labels import SPLITS
from mimic.trainers.config import TRAINERS

CONTROLLERS = ("policy", "hold", "pd", "computed_torque", "searched")
EXPORT_FORMATS = ("onnx", "jax")
_LAST_PORT = 65535


@dataclasses.dataclass(frozen=True)
class EvaluateConfig:
    """An evaluation of a trained policy, or of another controller in its place.

    Attributes:
      run: the run directory.
      checkpoint: environment steps of the checkpoint; the last one where None.
      controller: "policy", what a user would do without it (see `run_controller`), or "searched" (see
        `search_torques`).
      search: how long "searched" searches.
      demonstrations: file of demonstrations to evaluate on in place of the held-out ones.
      physics: see `EnvConfig`; the run's where empty.
      mass, damping, torque_noise: how the arm differs from its model, see `RandomizationConfig`; as in training where
        None.
      out: new folder for report, table and plots; the report is printed only where empty.
      compilation_cache: see `TrainConfig`.
    """

    run: str = ""
    checkpoint: int | None = None
    controller: str = "policy"
    search: SearchConfig = dataclasses.field(default_factory=SearchConfig)
    demonstrations: str = ""
    physics: str = ""
    mass: float | None = None
    damping: float | None = None
    torque_noise: float | None = None
    out: str = ""
    compilation_cache: str = "~/.cache/mimic/jax"

    def __post_init__(self) -> None:
        check_choice("controller", self.controller, CONTROLLERS)
        if self.physics:
            check_choice("physics", self.physics, PHYSICS)


@dataclasses.dataclass(frozen=True)
class FiguresConfig:
    """The figures of static pose imitation.

    Attributes:
      out: folder for the figures.
      only: names of some of them; all where empty.
      runs: folder of the mappers' run directories, one for each environment; `runs` within `out` where empty.
      seed: of mappers that must be trained.
      compilation_cache: see `TrainConfig`.
    """

    out: str = ""
    only: list[str] = dataclasses.field(default_factory=list)
    runs: str = ""
    seed: int = 0
    compilation_cache: str = "~/.cache/mimic/jax"


@dataclasses.dataclass(frozen=True)
class RenderConfig:
    """A video of a trained policy, of a pose mapper, or of retargeted motions.

    Attributes:
      run: the run directory of a policy or a pose mapper.
      checkpoint: steps of the checkpoint; the last one where None.
      split: "held_out" or "train": demonstrations of a policy's run.
      demonstration: which one of these, of those in a file, or of those that are recorded for a pose mapper, from 0.
      demonstrations: file of the expert's; for a pose mapper they are recorded, as its environment says, where empty.
      seed: of the recorded ones.
      retargeted: file of the learner's motions that `mimic.retarget` made of `demonstrations`.
      learner: name of the environment that these were retargeted for.
      limits: see `EnvConfig`; those that they were retargeted with.
      out: the file; a name in DIR/videos of the run directory where empty.
      gif: whether to make a GIF too.
      compilation_cache: see `TrainConfig`.
    """

    run: str = ""
    checkpoint: int | None = None
    split: str = "held_out"
    demonstration: int = 0
    demonstrations: str = ""
    seed: int = 0
    retargeted: str = ""
    learner: str = ""
    limits: str = "none"
    out: str = ""
    gif: bool = False
    compilation_cache: str = "~/.cache/mimic/jax"

    def __post_init__(self) -> None:
        check_choice("split", self.split, ("held_out", "train"))


@dataclasses.dataclass(frozen=True)
class ExportConfig:
    """A trained policy or pose mapper as a file for other programs.

    Attributes:
      run: the run directory.
      out: the file; must not exist.
      format: "onnx" or "jax".
      learner: name of the environment whose arms it is meant for; any where empty.
      checkpoint: steps of the checkpoint; the last one where None.
    """

    run: str = ""
    out: str = ""
    format: str = "onnx"
    learner: str = ""
    checkpoint: int | None = None

    def __post_init__(self) -> None:
        check_choice("format", self.format, EXPORT_FORMATS)


@dataclasses.dataclass(frozen=True)
class CollectConfig:
    """A collection of runs.

    Attributes:
      folder: that they lie in, at any depth.
      out: folder for table, figure and numbers; `folder` where empty.
      only: trainer whose runs alone are collected; where empty all runs must be of the same.
    """

    folder: str = ""
    out: str = ""
    only: str = ""

    def __post_init__(self) -> None:
        if self.only:
            check_choice("only", self.only, tuple(TRAINERS))


@dataclasses.dataclass(frozen=True)
class RecordingConfig:
    """A recording of demonstrations to a file.

    Attributes:
      env: the environment whose expert is recorded, in its time steps.
      kind, count, seed: see `DemonstrationConfig`; those of the environment where None.
      limits: see `EnvConfig`; those of the environment where None.
      source: file of motions to read instead of recording: see `import_demonstrations`.
      joints: what that file calls the expert's joints, base to tip; by the expert's own names where empty.
      out: the file, which ends in .npz; must not exist.
      plot: picture of what was recorded; `out` with .png instead where empty. Must not exist.
    """

    env: EnvConfig = dataclasses.field(default_factory=EnvConfig)
    kind: str | None = None
    count: int | None = None
    seed: int | None = None
    limits: str | None = None
    source: str = ""
    joints: list[str] = dataclasses.field(default_factory=list)
    out: str = ""
    plot: str = ""

    def resolve(self) -> EnvConfig:
        """The environment with what is given here.

        Raises:
          ValueError: a value that it cannot have.
        """
        wanted = {name: getattr(self, name) for name in ("kind", "count", "seed")}
        demonstrations = dataclasses.replace(self.env.demonstrations, **_given(wanted))
        return dataclasses.replace(self.env, demonstrations=demonstrations, **_given({"limits": self.limits}))


@dataclasses.dataclass(frozen=True)
class InspectConfig:
    """A look at a learner before it is trained.

    Attributes:
      learner: the arm in question.
      expert: what it shall imitate.
      limits: see `EnvConfig`.
      bound: whether to say how near the learner can come, which takes a minute.
      out: new folder for a picture of both arms with their correspondence, one of poses of the expert with the
        learner's nearest ones (where `bound`), and for what was found as JSON.
    """

    learner: ArmConfig = dataclasses.field(default_factory=ArmConfig)
    expert: ArmConfig = dataclasses.field(default_factory=ArmConfig)
    limits: str = "none"
    bound: bool = True
    out: str = ""

    def __post_init__(self) -> None:
        check_choice("limits", self.limits, LIMITS)


@dataclasses.dataclass(frozen=True)
class RetargetConfig:
    """A retargeting of demonstrations.

    Attributes:
      demonstrations: file of the expert's.
      learner: name of the environment whose arms and metric count.
      mapper: run directory of a pose mapper of that environment, which is used instead of the optimiser.
      limits: see `EnvConfig`.
      out: file of the learner's; must not exist.
      seed: of the random poses that minima are searched from.
    """

    demonstrations: str = ""
    learner: str = "panda4dof"
    mapper: str = ""
    limits: str = "none"
    out: str = ""
    seed: int = 0


@dataclasses.dataclass(frozen=True)
class ViewConfig:
    """A live view of two arms.

    Attributes:
      env: the arms and the metric.
      expert, learner: arms in place of the environment's: "panda", the name of an environment, or an MJCF file.
      mapper: run directory of a pose mapper that moves the learner, instead of the optimiser; brings its own arms.
      run: run directory of a policy to play; brings its own arms and demonstrations.
      checkpoint: of the policy or the mapper; the last one where None.
      split: "held_out" or "train", the demonstrations of the run that are shown first.
      host: address to serve at; 0.0.0.0 is every address of this machine.
      port: to serve at.
      compilation_cache: see `TrainConfig`.
    """

    env: EnvConfig = dataclasses.field(default_factory=EnvConfig)
    expert: str = ""
    learner: str = ""
    mapper: str = ""
    run: str = ""
    checkpoint: int | None = None
    split: str = "held_out"
    host: str = "127.0.0.1"
    port: int = 8080
    compilation_cache: str = "~/.cache/mimic/jax"

    def __post_init__(self) -> None:
        check_choice("split", self.split, SPLITS)
        if not 1 <= self.port <= _LAST_PORT:
            raise ValueError(f"port: expected 1 to {_LAST_PORT}, got {self.port}")
        if self.run and self.mapper:
            raise ValueError(f"run, mapper: expected one of them, got {self.run!r} and {self.mapper!r}")
        if (self.run or self.mapper) and (self.expert or self.learner):
            raise ValueError("expert, learner: a run brings its own arms; expected neither beside run= or mapper=")

    def resolve_env(self) -> EnvConfig:
        """The environment with the arms that are named here.

        Raises:
          ValueError: an arm that does not exist.
        """
        given = {role: _arm(role, name) for role in ("expert", "learner") if (name := getattr(self, role))}
        return dataclasses.replace(self.env, **given)


def _given(values: dict[str, Any]) -> dict[str, Any]:
    return {name: value for name, value in values.items() if value is not None}


def _arm(role: str, name: str) -> ArmConfig:
    if name == "panda":
        return ArmConfig()
    if name in environments():
        return getattr(env_config(name), role)
    if not Path(name).expanduser().is_file():
        valid = ", ".join(environments())
        raise ValueError(f"{role}: expected panda, an MJCF file, or an environment ({valid}), got {name!r}")
    return ArmConfig(model=str(Path(name).expanduser()))
