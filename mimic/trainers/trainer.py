"""The interface of a trainer: inputs, training and evaluation. `mimic.trainers.run_training` does the rest."""

import abc
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from mimic.envs.config import EnvConfig
from mimic.runs.checkpoints import Checkpoint
from mimic.runs.signals import Signals
from mimic.trainers.config import TrainerConfig

Params = Any  # pytree
Metrics = dict[str, Any]  # quality metrics of a report, some by split
OnEvaluation = Callable[[int, Params, Mapping[str, float]], None]  # steps, parameters, training metrics
Row = tuple[str, str, str]  # of the final table: label, value on training data, value on held-out data


class Trainer(abc.ABC):
    """Trains and evaluates one run.

    Attributes:
      settings: the trainer's config, resolved.
      env_config: the config of the environment, resolved.
      headline: one line for people: the environment, the arms and the training data.
      simulation: one line for people: the physics and why; empty where nothing is simulated.
      total_steps: training steps of the whole run.
      unit: name of a training step, as its key in the report.
      columns: headers of the final table for the splits "train" and "held_out".
    """

    settings: TrainerConfig
    env_config: EnvConfig
    headline: str
    simulation: str = ""
    total_steps: int
    unit: str
    columns: tuple[str, str] = ("training", "held out")

    def save_inputs(self, run_dir: Path) -> None:
        """Writes the inputs that reproduce the run, in addition to its config; none by default."""
        del run_dir

    @abc.abstractmethod
    def params_template(self) -> Params:
        """Parameters, or their shapes, with the structure of a checkpoint."""

    @abc.abstractmethod
    def train(
        self, run_dir: Path, on_evaluation: OnEvaluation, signals: Signals, restored: Checkpoint | None
    ) -> tuple[int, Params]:
        """Trains, and saves a checkpoint before each call of `on_evaluation`.

        Args:
          run_dir: folder of the checkpoints.
          on_evaluation: called after each training epoch.
          signals: signals of the process; after one, training ends at the next checkpoint.
          restored: checkpoint to continue from, which is evaluated again. At step 0, if `run_dir` does not
            have it, it has the parameters to start from.

        Returns:
          Steps and parameters of the result.

        Raises:
          Interrupted: a signal was received; a checkpoint has been written.
          Diverged: a number is not finite; the checkpoints before it are kept.
          OSError: a checkpoint cannot be written.
        """

    def policy(self, params: Params) -> Callable[[Any], Any]:
        """The trained function, compiled: of an observation to an action, or of an expert's pose to a learner's.

        Raises:
          ValueError: the trainer has no such function.
        """
        del params
        raise ValueError(f"trainer {self.settings.name} has no policy")

    def follow(self, restored: Checkpoint | None) -> None:
        """Trains in a process other than the first, which alone evaluates and writes; returns when training ends."""
        del restored
        raise NotImplementedError

    @abc.abstractmethod
    def evaluate(self, params: Params) -> Any:
        """Evaluates parameters; the result is the argument of `metrics`, `details` and `save_outcome`."""

    def run_controller(self, name: str, params: Params) -> tuple[Any, dict[str, Any]]:
        """Evaluates a controller, which may be another one than the trained policy.

        Args:
          name: the controller; "policy" is the trained one.
          params: parameters of the trained policy.

        Returns:
          The result of `evaluate`, and the controller's entries of the report.
        """
        assert name == "policy", name
        return self.evaluate(params), {}

    @abc.abstractmethod
    def metrics(self, outcome: Any) -> Metrics:
        """Quality metrics of an evaluation."""

    @abc.abstractmethod
    def status(self, metrics: Metrics) -> str:
        """The most important metrics as a short text, for the progress display."""

    @abc.abstractmethod
    def rows(self, metrics: Metrics) -> list[Row]:
        """Rows of the final table."""

    def details(self, outcome: Any, controller: str = "policy") -> Metrics:
        """Entries of the final report beyond the metrics; `similarity` is shown as a separate table."""
        del outcome, controller
        return {}

    def cross_check(self, params: Params) -> Metrics:
        """Entries of the final report by another simulation than that of the training; none by default."""
        del params
        return {}

    @abc.abstractmethod
    def save_outcome(self, folder: Path, outcome: Any, controller: str = "policy") -> None:
        """Writes plots and tables of a controller's evaluation, and in a run directory of its training."""
