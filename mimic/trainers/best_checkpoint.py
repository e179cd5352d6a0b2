"""The checkpoint of a training with the smallest score, where that is the result and not the last one."""

import math
import sys
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any, NamedTuple

from mimic.runs.checkpoints import Checkpoint, DamagedCheckpoint, checkpoint_steps, load_checkpoint

Score = Callable[[Any], float]  # of parameters, the smaller the better


class Best(NamedTuple):
    """The checkpoint with the smallest score so far."""

    score: float
    step: int
    params: Any


def better(best: Best | None, checkpoints: Iterable[Checkpoint], score: Score) -> Best | None:
    """The best of the best so far and of some checkpoints; the earlier one of equal ones."""
    for checkpoint in checkpoints:
        value = score(checkpoint.params)
        value = value if math.isfinite(value) else math.inf
        if best is None or value < best.score:
            best = Best(value, checkpoint.step, checkpoint.params)
    return best


def best_saved(run_dir: Path, restored: Checkpoint, score: Score) -> Best | None:
    """The best checkpoint of a resumed run before the restored one; None where there is none."""
    best = None
    for step in checkpoint_steps(run_dir):
        if step < restored.step:
            try:
                saved = Checkpoint(*load_checkpoint(run_dir, restored.params, step), None, {})
            except DamagedCheckpoint as error:
                print(f"warning: {error}; it cannot be the result", file=sys.stderr)
                continue
            best = better(best, [saved], score)
    return best
