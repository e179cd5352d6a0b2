"""The newest checkpoint of a run that another process trains, evaluated in a background thread. Needs no browser."""

import time
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from typing import NamedTuple

from mimic.evaluation.evaluator import Rollouts
from mimic.runs.checkpoints import checkpoint_steps, load_checkpoint
from mimic.runs.files import reported_steps
from mimic.trainers.ppo.trainer import PPOTrainer

_PERIOD = 0.5  # s between two looks into the run directory


class Evaluation(NamedTuple):
    """The policy of a checkpoint on all demonstrations.

    Attributes:
      rollouts: see `Rollouts`.
      text: training steps and optimality gap, in one line.
    """

    rollouts: Rollouts
    text: str


class NewestCheckpoint:
    """Evaluates the newest checkpoint of a run, again and again; reads the run directory and writes nothing.

    Args:
      trainer: trainer of the run.
      run_dir: directory of the run, which may have no checkpoint yet.
    """

    def __init__(self, trainer: PPOTrainer, run_dir: Path):
        self._trainer, self._run_dir = trainer, run_dir
        self._executor = ThreadPoolExecutor(1, thread_name_prefix="checkpoint")
        self._future: Future[Evaluation] | None = None
        self._step: int | None = None  # of the last checkpoint that was read
        self._next_look = 0.0
        self._is_complete = False

    @property
    def exists(self) -> bool:
        """Whether the run has a checkpoint."""
        return bool(checkpoint_steps(self._run_dir))

    def start(self) -> None:
        """Starts to compile the evaluation and to compute the kinematic bound."""
        self._trainer.prepare_evaluation()

    def advance(self) -> Evaluation | None:
        """Returns a new evaluation, once; None while there is no new one. Does not wait for it.

        Raises:
          ValueError: the checkpoint is damaged or does not fit the run; the next one is tried afterwards.
        """
        if self._future is None:
            self._look()
            return None
        if not self._future.done():
            return None
        future, self._future = self._future, None
        try:
            return future.result()
        except (OSError, ValueError):
            if self._step in checkpoint_steps(self._run_dir):
                raise
            return None  # the training removed it meanwhile

    def _look(self) -> None:
        """Starts to evaluate the newest checkpoint, or once more when the training has ended with it."""
        if time.monotonic() < self._next_look:
            return
        self._next_look = time.monotonic() + _PERIOD
        newest = max(checkpoint_steps(self._run_dir), default=None)
        is_complete = newest is not None and reported_steps(self._run_dir, self._trainer.unit) == newest
        if newest is not None and (newest, is_complete) != (self._step, self._is_complete):
            self._step, self._is_complete = newest, is_complete
            self._future = self._executor.submit(self._evaluate, newest, is_complete)

    def _evaluate(self, step: int, is_complete: bool) -> Evaluation:
        trainer = self._trainer
        _, params = load_checkpoint(self._run_dir, trainer.params_template(), step)
        rollouts = trainer.evaluate(params)
        progress = f"step {step:,}, training ended" if is_complete else f"step {step:,} of {trainer.total_steps:,}"
        return Evaluation(rollouts, f"{progress}: {trainer.status(trainer.metrics(rollouts))}")

    def finish(self) -> None:
        """Waits for a running evaluation: a process must not end during its compilation."""
        self._executor.shutdown(wait=True, cancel_futures=True)
