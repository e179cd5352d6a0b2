"""`mimic.load`: a trained network that comes with the package, as a function."""

import dataclasses
import functools
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any, Literal, cast

import jax.numpy as jnp
from jax.typing import ArrayLike
from jaxtyping import Array, Float

from mimic.arms.embodiment import Embodiment
from mimic.base import compat
from mimic.base.config import check_choice
from mimic.runs.files import read_report
from mimic.runs.parameters import read_params
from mimic.trainers.config import PPOConfig, TrainConfig
from mimic.trainers.pretrained import NETWORKS, pretrained_names
from mimic.trainers.pretrained.files import SOURCE
from mimic.trainers.run_config import load_config

if TYPE_CHECKING:
    from mimic.envs.imitation import ImitationEnv

TRAINERS = {"policy": "ppo", "pose_mapper": "pose_mapper"}  # of each kind of network
_ORIGIN = ("env", "trainer", "seed", "env_steps", "training_poses", "wall_time_s", "hardware", "versions")

Function = Callable[[ArrayLike], Array]


@dataclasses.dataclass(frozen=True, eq=False, repr=False)
class Pretrained:
    """A trained network. Call it with one input or a batch; safe under `jax.jit` and `jax.vmap`.

    Attributes:
      name: name of the environment.
      kind: "policy" or "pose_mapper".
      config: config of the training run, with all values resolved.
      report: the metrics of these weights, as in report.json of a run; see `docs/training.md`.
      function: what a call computes; for a pose mapper a `PoseMapper`.
    """

    name: str
    kind: str
    config: TrainConfig
    report: dict[str, Any]
    function: Function

    def __call__(self, x: Float[ArrayLike, "*batch inputs"]) -> Float[Array, "*batch outputs"]:
        """The output of the network.

        Args:
          x: for a policy observations of `env`, for a pose mapper poses of the expert [rad].

        Returns:
          For a policy actions in [-1, 1], fractions of `env.torque_scale` [N m]; for a pose mapper poses of the
          learner [rad].

        Raises:
          ValueError: an input of another size; for a pose mapper also a pose outside of the expert's joint range.
        """
        return self.function(x)

    def __repr__(self) -> str:
        gap = self.report["optimality_gap" if self.kind == "policy" else "quality"]["held_out"]
        return f"Pretrained({self.name!r}, {self.kind!r}, gap {gap:.2%} on held-out data)"

    @property
    def source(self) -> dict[str, Any]:
        """Where the weights come from: command, commit, seed, training steps, time, versions and hardware."""
        return {**self.report[SOURCE], **{key: self.report[key] for key in _ORIGIN if key in self.report}}

    @functools.cached_property
    def env(self) -> "ImitationEnv":
        """The environment, with its training demonstrations."""
        compat.import_mjx()
        from mimic.envs.make import make_env  # imports brax and MJX, which takes seconds

        return make_env(self.config.env)

    @functools.cached_property
    def _arms(self) -> tuple[Embodiment, Embodiment]:
        return self.config.env.build_arms().embodiments

    @property
    def expert(self) -> Embodiment:
        """The arm that is imitated."""
        return self._arms[0]

    @property
    def learner(self) -> Embodiment:
        """The arm that imitates."""
        return self._arms[1]


def load(name: str, kind: Literal["policy", "pose_mapper"] = "policy") -> Pretrained:
    """Loads a trained network that comes with mimic. Nothing is downloaded.

    Args:
      name: name of an environment, as in `mimic.make`.
      kind: "policy", or "pose_mapper".

    Returns:
      The network.

    Raises:
      ValueError: there is no such network.
    """
    check_choice("kind", kind, tuple(TRAINERS))
    check_choice("name", name, pretrained_names(kind))
    return read_network(NETWORKS / f"{name}-{kind}", kind)


def read_network(folder: Path, kind: str) -> Pretrained:
    """The network in a folder that `write_network` wrote.

    Raises:
      ValueError: a file is missing, damaged, or of another kind of network.
    """
    config = load_config(folder)
    if config.trainer.name != TRAINERS[kind]:
        raise ValueError(f"{str(folder)!r}: expected a network of trainer={TRAINERS[kind]}, got {config.trainer.name}")
    function = _policy(folder, config) if kind == "policy" else _mapper(folder, config)
    return Pretrained(config.env.name, kind, config, read_report(folder), function)


def policy_template(config: TrainConfig) -> tuple[Any, Any]:
    """Shapes of a policy's parameters: statistics of the observations, and the policy network."""
    compat.import_mjx()
    from mimic.trainers.ppo import ppo

    observation_size, joints = _policy_sizes(config)
    return ppo.params_template(cast(PPOConfig, config.trainer), observation_size, joints, 0)[:2]  # any critic


def _policy_sizes(config: TrainConfig) -> tuple[int, int]:
    """Size of the observation, and number of the learner's joints."""
    from mimic.envs.imitation import observation_layout

    expert, learner = map(config.env.metric.compared, config.env.build_arms().embodiments)
    return observation_layout(expert, learner, config.env.preview, {})[-1]["stop"], learner.num_joints


def _policy(folder: Path, config: TrainConfig) -> Function:
    compat.import_mjx()
    from mimic.trainers.ppo import ppo  # brax and MJX, which take seconds to import

    params = read_params(folder, policy_template(config))
    size, joints = _policy_sizes(config)
    no_value_network = (*params, None)
    controller = ppo.make_controller(cast(PPOConfig, config.trainer), size, joints)(no_value_network)

    def policy(observation: ArrayLike) -> Array:
        values = jnp.asarray(observation)
        if values.shape[-1:] != (size,):
            raise ValueError(f"observation: expected shape [..., {size}], got {list(values.shape)}")
        return controller(SimpleNamespace(obs=values))  # type: ignore[arg-type]

    return policy


def _mapper(folder: Path, config: TrainConfig) -> Function:
    from mimic.trainers.pose_mapper.mapper import PoseMapper  # imports flax networks

    return PoseMapper.read(config, lambda template: read_params(folder, template))
