"""The first batch of a training that is not finite: found by repeating single batches, saved, and loaded again."""

import os
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple

import jax
import numpy as np

from mimic.base.npz import read_arrays
from mimic.runs.checkpoints import run_id
from mimic.runs.divergence import FILE
from mimic.trainers.ppo.programs import BatchRecord, Replay, TrainingState, of_all_processes, saved_leaves
from mimic.trainers.ppo.updates import TRACED

_BAD_ARMS, _OTHER_ARMS, _STEPS = 8, 4, 10  # that a file holds at most
_MAX_LEAVES = 1000  # of a training's state, which has some 60
_LEAF = "state_{}"
_OF_ARMS = ("qpos", "qvel", "observation", "action", "reward")
_UNROLLED = ("observation", "action", "reward")
_STATISTICS, _PARAMETER = "observation statistics", "parameter"
_CAUSES = (*_UNROLLED, _STATISTICS, *TRACED, _PARAMETER)
_COUNTS = ("env_steps", "batch", "batches", "devices", "index", "of", "num_bad_arms")


class Finding(NamedTuple):
    """The first value of a batch that is not finite.

    Attributes:
      what: "observation", "action" or "reward", "observation statistics", a metric of `TRACED`, or "parameter".
      index: step of the batch for the first three, otherwise the update; both from 0.
      of: number of steps or updates in a batch.
      arms: indices of the arms at fault; empty for updates.
    """

    what: str
    index: int
    of: int
    arms: np.ndarray

    @property
    def in_unrolls(self) -> bool:
        """Whether arms are at fault, and not an update."""
        return self.what in _UNROLLED

    def __str__(self) -> str:
        place = f"{'step' if self.in_unrolls else 'update'} {min(self.index + 1, self.of)} of {self.of}"
        return f"{self.what.replace('_', ' ')} in {place}"


class Epoch(NamedTuple):
    """A training epoch.

    Attributes:
      env_steps: environment steps before it.
      batches: number of its batches.
      state: leaves of the training's state before it, see `TrainingState.saved`.
    """

    env_steps: int
    batches: int
    state: Sequence[np.ndarray]


class BadBatch(NamedTuple):
    """A batch that is not finite.

    Attributes:
      batch: its number in the training epoch, from 1.
      state: leaves of the training's state before the batch, see `TrainingState.saved`.
      key: the training's random key before the batch.
      finding: what is not finite.
      record: on the host.
    """

    batch: int
    state: Sequence[np.ndarray]
    key: np.ndarray
    finding: Finding
    record: BatchRecord


class Divergence(NamedTuple):
    """The content of a divergence file.

    Attributes:
      run: name of the run in its checkpoints.
      env_steps: environment steps before the training epoch.
      batch, batches: number of the batch in the epoch, from 1, and number of batches in the epoch.
      devices: number of devices of the training.
      num_bad_arms: number of arms at fault.
      finding: what was not finite; its arms are at most eight of those at fault.
      metrics: [updates, `TRACED`] of the batch.
      state: see `BadBatch`.
    """

    run: str
    env_steps: int
    batch: int
    batches: int
    devices: int
    num_bad_arms: int
    finding: Finding
    metrics: np.ndarray
    state: Sequence[np.ndarray]


def record_divergence(run_dir: Path | None, make_replay: Callable[[], Replay], epoch: Epoch) -> Path | None:
    """Writes the first batch of an epoch that is not finite. A failure is a warning: the divergence is the error.

    Args:
      run_dir: the run directory; None in other processes than the first, which do not write.
      make_replay: compiles the functions that repeat single batches.
      epoch: the training epoch that is not finite.

    Returns:
      The file; None where it cannot be written, or where the batches are finite when they run one at a time.
    """
    if run_dir:
        place = f"{epoch.batches} batches after {epoch.env_steps} steps"
        print(f"training diverged: looking for the first of {place} that is not finite", flush=True)
    try:
        bad = find_bad_batch(make_replay(), epoch)
        if bad and run_dir:
            save_divergence(run_dir / FILE, bad, run_id(run_dir), epoch)
    except Exception as error:
        reason = " ".join(f"{type(error).__name__}: {error}".split())[:300]
        print(f"warning: the batch that is not finite cannot be recorded: {reason}", file=sys.stderr, flush=True)
        return None
    if run_dir and not bad:
        print("all batches are finite when they run one at a time", flush=True)
    return run_dir / FILE if bad and run_dir else None


def find_bad_batch(replay: Replay, epoch: Epoch) -> BadBatch | None:
    """Repeats a training epoch batch by batch, up to the first one that is not finite; None where all are finite."""
    state = replay.restore(epoch.state)
    assert state is not None
    for batch in range(1, epoch.batches + 1):
        before, key = saved_leaves(state), jax.device_get(state.key)
        state, record, finding = replay_batch(replay, state)
        if finding:
            return BadBatch(batch, before, key, finding, record)
    return None


def replay_batch(replay: Replay, state: TrainingState) -> tuple[TrainingState, BatchRecord, Finding | None]:
    """Runs one batch; returns the state after it, and on the host a record and what is not finite.

    A value that is not finite in the unrolls makes a metric so. Only then are the unrolls copied and examined.
    """
    state, record = replay.batch()(state)
    trace, statistics = jax.device_get((record.trace, state.statistics))
    record = record._replace(trace=trace)
    statistics_are_finite = all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(statistics))
    if trace.finite.all() and np.isfinite(trace.metrics).all() and statistics_are_finite:
        return state, record, None
    unrolls, qpos, qvel = of_all_processes((record.unrolls, record.qpos, record.qvel))
    record = BatchRecord(unrolls, qpos, qvel, trace)
    return state, record, examine(record, statistics_are_finite)


def examine(record: BatchRecord, statistics_are_finite: bool = True) -> Finding | None:
    """The first value that is not finite, in the order of computation: unrolls, statistics, updates.

    Args:
      record: on the host.
      statistics_are_finite: whether the running statistics of the observations are, after the batch.
    """
    steps = record.qpos.shape[0] * record.qpos.shape[1]
    findings = []
    for order, (what, values) in enumerate(_unrolled(record).items()):
        bad = ~np.asarray(np.isfinite(values.reshape(*values.shape[:2], -1)).all(axis=2))
        if bad.any():
            step = int(bad.any(axis=1).argmax())
            findings.append((step, order, Finding(what, step, steps, np.flatnonzero(bad[step]))))
    if findings:
        return min(findings, key=lambda entry: entry[:2])[-1]
    finite = np.column_stack([np.isfinite(record.trace.metrics), record.trace.finite])
    if not statistics_are_finite:
        return Finding(_STATISTICS, 0, len(finite), np.zeros(0, int))
    if finite.all():
        return None
    update = int((~finite).any(axis=1).argmax())
    return Finding((*TRACED, _PARAMETER)[int((~finite[update]).argmax())], update, len(finite), np.zeros(0, int))


def _unrolled(record: BatchRecord) -> dict[str, np.ndarray]:
    """The values that are examined, [steps + 1, arms, ...], in the order of computation in a step."""
    unrolls = record.unrolls
    action = np.concatenate([unrolls.raw_action, unrolls.log_prob[..., None]], axis=-1)
    values = dict(zip(_UNROLLED, (unrolls.observation, action, unrolls.reward), strict=True))
    # The last sample of an unroll is the first one of the next, except in the last unroll.
    return {name: np.concatenate([x[:, :-1].reshape(-1, *x.shape[2:]), x[-1, -1:]]) for name, x in values.items()}


def arm_values(record: BatchRecord) -> dict[str, np.ndarray]:
    """Joint angles, joint velocities, observations, actions in [-1, 1] and rewards, [steps, arms, ...].

    Args:
      record: on the host. Rewards belong to the step, all others to the time before it.
    """
    unrolls, steps = record.unrolls, record.qpos.shape[1]
    values = record.qpos, record.qvel, unrolls.observation, np.tanh(np.asarray(unrolls.raw_action)), unrolls.reward
    arrays = zip(_OF_ARMS, map(np.asarray, values), strict=True)
    return {name: x[:, :steps].reshape(-1, *x.shape[2:]) for name, x in arrays}


def save_divergence(path: Path, bad: BadBatch, run: str, epoch: Epoch) -> None:
    """Writes what repeats a batch, and where arms are at fault, their last steps and those of some other arms.

    Args:
      path: the file; an existing one is replaced.
      bad: the batch.
      run: name of the run in its checkpoints.
      epoch: its training epoch.
    """
    finding = bad.finding
    place = epoch.env_steps, bad.batch, epoch.batches, jax.device_count()
    counts = *place, finding.index, finding.of, len(finding.arms)
    arrays = {
        "run": run,
        "what": finding.what,
        **dict(zip(_COUNTS, counts, strict=True)),
        "key": bad.key,
        "metric_names": np.array(TRACED),
        "metrics": bad.record.trace.metrics,
        **_last_steps(bad.record, finding),
        **{_LEAF.format(i): leaf for i, leaf in enumerate(bad.state)},
    }
    partial = path.with_name(path.name + ".partial")
    try:
        with partial.open("wb") as file:
            np.savez(file, **arrays)  # type: ignore[arg-type]
        os.replace(partial, path)
    finally:
        partial.unlink(missing_ok=True)


def _last_steps(record: BatchRecord, finding: Finding) -> dict[str, np.ndarray]:
    """The last steps of some arms at fault and of some others; empty arrays where an update is at fault."""
    bad_arms = finding.arms[:_BAD_ARMS]
    others = np.setdiff1d(np.arange(record.qpos.shape[2]), finding.arms)[:_OTHER_ARMS]
    arms, steps = np.concatenate([bad_arms, others]), np.arange(finding.of)[: finding.index + 1][-_STEPS:]
    if not finding.in_unrolls:
        arms, steps = bad_arms, steps[:0]
    of_arms = {name: values[steps][:, arms] for name, values in arm_values(record).items()}
    return {"bad_arms": bad_arms, "arms": arms, "steps": steps, **of_arms}


def load_divergence(path: Path) -> Divergence:
    """Reads a file of `save_divergence`.

    Raises:
      ValueError: another or a damaged file.
    """
    try:
        leaves = [_LEAF.format(i) for i in range(_MAX_LEAVES)]
        arrays = read_arrays(path, {"run", "what", "metrics", "bad_arms", *_COUNTS, *leaves})
        counts = {name: int(arrays[name]) for name in _COUNTS}
        what, metrics, arms = str(arrays["what"]), arrays["metrics"], arrays["bad_arms"]
        state = [arrays[name] for name in leaves if name in arrays]
        finding = Finding(what, counts.pop("index"), counts.pop("of"), arms)
        last = finding.of if finding.in_unrolls else len(metrics) - 1
        valid = (
            what in _CAUSES
            and (metrics.dtype.kind, metrics.ndim, metrics.shape[-1]) == ("f", 2, len(TRACED))
            and (arms.dtype.kind, arms.ndim) == ("i", 1)
            and 0 <= finding.index <= last
            and len(metrics) > 0
            and min(counts.values()) >= 0
        )
        if not valid:
            raise ValueError("its values have other types, shapes or ranges")
    except (ValueError, TypeError, LookupError, OverflowError) as error:
        reason = f"it has no {error}" if isinstance(error, KeyError) else error
        raise ValueError(f"{str(path)!r} is no file of a training that diverged: {reason}") from error
    return Divergence(run=str(arrays["run"]), finding=finding, metrics=metrics, state=state, **counts)
