"""What `python -m mimic.view` is told, and the arms that it means."""

import dataclasses
from pathlib import Path

from mimic.arms.arm import ArmConfig
from mimic.config import check_choice
from mimic.envs import env_config, environments
from mimic.envs.config import EnvConfig

SPLITS = ("held_out", "train")
_LAST_PORT = 65535


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


def _arm(role: str, name: str) -> ArmConfig:
    if name == "panda":
        return ArmConfig()
    if name in environments():
        return getattr(env_config(name), role)
    if not Path(name).expanduser().is_file():
        valid = ", ".join(environments())
        raise ValueError(f"{role}: expected panda, an MJCF file, or an environment ({valid}), got {name!r}")
    return ArmConfig(model=str(Path(name).expanduser()))
