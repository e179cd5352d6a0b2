"""What a trainer brings to a run: its inputs, its training, and how good the result is. The session does the rest."""

import abc
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from mimic.evaluation.config import SearchConfig
from mimic.runs.signals import Signals
from mimic.trainers.config import TrainerConfig

Params = Any  # pytree
Figures = dict[str, Any]  # quality figures of a report, some by split
OnEvaluation = Callable[[int, Params, Mapping[str, float]], bool]  # steps, metrics of the training; whether to stop
OnUpdate = Callable[[int, str], None]
Row = tuple[str, str, str]  # of the final table: label, on training data, on held-out data


class Trainer(abc.ABC):
    """A run as its trainer sees it.

    Attributes:
      settings: the trainer's config, resolved.
      headline: what is trained on what, for people.
      total_steps: how long training goes on.
      unit: what a step is; its key in the report.
    """

    settings: TrainerConfig
    headline: str
    total_steps: int
    unit: str

    @abc.abstractmethod
    def save_inputs(self, run_dir: Path) -> None:
        """Writes what the run needs to be repeated, beside its config."""

    @abc.abstractmethod
    def params_template(self) -> Params:
        """Parameters of the right structure, to restore a checkpoint into."""

    @abc.abstractmethod
    def train(
        self, run_dir: Path, on_evaluation: OnEvaluation, signals: Signals, restore: tuple[int, Params] | None
    ) -> tuple[int, Params]:
        """Trains; saves a checkpoint before each call of `on_evaluation`.

        Args:
          run_dir: where checkpoints go.
          on_evaluation: training ends where it returns True.
          signals: training ends after the next checkpoint if one came.
          restore: steps and parameters to go on from.

        Returns:
          Steps and parameters of the result.

        Raises:
          Interrupted: a signal came; a checkpoint is written.
        """

    def follow(self, restore: tuple[int, Params] | None) -> None:
        """Trains in step with the first process, which does all the rest; returns when that has trained to the end."""
        del restore
        raise NotImplementedError

    @abc.abstractmethod
    def evaluate(self, params: Params) -> Any:
        """What `figures`, `details` and `save_outcome` are made of."""

    def run_controller(
        self, name: str, params: Params, search: SearchConfig, on_update: OnUpdate
    ) -> tuple[Any, dict[str, Any]]:
        """The same for a controller in the place of what was trained.

        Args:
          name: "policy" is what was trained.
          params: of that.
          search: how long "searched" searches.
          on_update: called with the number of updates of a search, from 0 on, and its state as text.

        Returns:
          As `evaluate`; and what the report says of the controller.
        """
        del search, on_update
        assert name == "policy", name
        return self.evaluate(params), {}

    @abc.abstractmethod
    def figures(self, outcome: Any) -> Figures:
        """Quality figures of an evaluation."""

    @abc.abstractmethod
    def status(self, figures: Figures) -> str:
        """The figures that a person watches while it trains, in a few words."""

    @abc.abstractmethod
    def good_enough(self, figures: Figures) -> bool:
        """Whether training may end."""

    @abc.abstractmethod
    def rows(self, figures: Figures) -> list[Row]:
        """The figures as rows of the final table."""

    def details(self, outcome: Any, controller: str = "policy") -> Figures:
        """What a report says of a controller beyond the figures; `similarity` is shown as a table of its own."""
        del outcome, controller
        return {}

    @abc.abstractmethod
    def save_outcome(self, folder: Path, outcome: Any, controller: str = "policy") -> None:
        """Writes plots and tables of an evaluation of a controller; in a run directory, of its training too."""
