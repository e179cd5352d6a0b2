"""The first batch of a training that is not finite: what is at fault, and its file."""

from typing import Any

import numpy as np
import pytest

from mimic.runs.divergence import FILE
from mimic.trainers.ppo import divergence
from mimic.trainers.ppo.divergence import (
    BadBatch,
    Epoch,
    Finding,
    examine,
    load_divergence,
    record_divergence,
    save_divergence,
)
from mimic.trainers.ppo.losses import Unrolls
from mimic.trainers.ppo.programs import BatchRecord
from mimic.trainers.ppo.updates import TRACED, UpdateTrace

ROUNDS, TIME, ARMS, JOINTS, OBSERVED, UPDATES = 3, 5, 20, 2, 7, 4
STATE = [np.arange(6, dtype=np.float32).reshape(2, 3), np.array(7)]


@pytest.fixture
def record():
    """A batch whose values are all finite."""
    rng = np.random.default_rng(0)

    def normal(*shape) -> Any:
        return rng.normal(size=(ROUNDS, TIME + 1, ARMS, *shape)).astype(np.float32)

    unrolls = Unrolls(normal(OBSERVED), normal(JOINTS), normal(), normal(), normal(), normal())
    metrics: Any = rng.normal(size=(UPDATES, len(TRACED)))
    finite: Any = np.ones(UPDATES, bool)
    trace = UpdateTrace(metrics, finite)
    return BatchRecord(unrolls, normal(JOINTS)[:, :-1], normal(JOINTS)[:, :-1], trace)


def finding_of(record, **options) -> Finding:
    finding = examine(record, **options)
    assert finding is not None
    return finding


def test_a_finite_batch_is_finite(record):
    assert examine(record) is None


@pytest.mark.parametrize(
    ("field", "place", "what", "step"),
    [
        ("observation", (1, 2, 13), "observation", 7),
        ("observation", (2, TIME, 13), "observation", 15),  # after the last step
        ("raw_action", (1, 2, 13), "action", 7),
        ("log_prob", (0, 0, 13), "action", 0),
        ("reward", (2, 4, 13), "reward", 14),
    ],
)
@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_the_first_value_of_an_arm_is_found(record, field, place, what, step, value):
    getattr(record.unrolls, field)[place] = value
    record.trace.metrics[:] = np.nan  # of the updates, which come later
    finding = finding_of(record, statistics_are_finite=False)
    assert finding[:3] == (what, step, ROUNDS * TIME)
    np.testing.assert_array_equal(finding.arms, [13])


def test_an_earlier_step_comes_first(record):
    record.unrolls.observation[1, 1, :4] = record.unrolls.reward[1, 0, 6:8] = np.nan
    finding = finding_of(record)
    assert str(finding) == "reward in step 6 of 15"
    np.testing.assert_array_equal(finding.arms, [6, 7])


def test_in_a_step_the_observation_comes_before_the_action_and_the_reward(record):
    for values in record.unrolls[:4]:
        values[1, 1, 4] = np.nan
    assert str(finding_of(record)) == "observation in step 7 of 15"
    record.unrolls.observation[1, 1, 4] = 0
    assert str(finding_of(record)) == "action in step 7 of 15"


@pytest.mark.parametrize("name", TRACED)
def test_the_first_metric_is_found(record, name):
    record.trace.metrics[2, TRACED.index(name) :] = np.inf
    record.trace.metrics[3:] = np.nan
    record.trace.finite[2:] = False
    assert finding_of(record)[:3] == (name, 2, UPDATES)


def test_parameters_and_statistics_are_found(record):
    record.trace.finite[3] = False
    assert str(finding_of(record)) == "parameter in update 4 of 4"
    assert finding_of(record, statistics_are_finite=False).what == "observation statistics"


def saved(record, folder, state=STATE):
    finding = finding_of(record)
    bad = BadBatch(2, state, np.array([1, 2], np.uint32), finding, record)
    save_divergence(folder / FILE, bad, "run", Epoch(100, 3, state))
    return folder / FILE


def test_a_file_holds_the_state_and_the_arms_at_fault(record, tmp_path):
    record.unrolls.raw_action[2, 4, 5:] = np.nan
    path = saved(record, tmp_path)
    loaded = load_divergence(path)
    assert (loaded.run, loaded.env_steps, loaded.batch, loaded.batches, loaded.num_bad_arms) == ("run", 100, 2, 3, 15)
    assert str(loaded.finding) == "action in step 15 of 15"
    np.testing.assert_array_equal(loaded.finding.arms, range(5, 13))
    np.testing.assert_array_equal(loaded.metrics, record.trace.metrics)
    for leaf, expected in zip(loaded.state, STATE, strict=True):
        np.testing.assert_array_equal(leaf, expected)
    with np.load(path) as file:
        np.testing.assert_array_equal(file["arms"], [*range(5, 13), 0, 1, 2, 3])
        np.testing.assert_array_equal(file["steps"], range(5, 15))
        np.testing.assert_array_equal(file["observation"][-1], record.unrolls.observation[2, 4, file["arms"]])
        np.testing.assert_array_equal(file["qpos"][0], record.qpos[1, 0, file["arms"]])
        assert file["action"].shape == (10, 12, JOINTS) and np.isnan(file["action"][-1, :8]).all()
        np.testing.assert_array_equal(file["key"], [1, 2])
    assert [entry.name for entry in tmp_path.iterdir()] == [FILE]


def test_a_file_holds_no_arms_where_an_update_is_at_fault(record, tmp_path):
    record.trace.metrics[3, 0] = np.nan
    path = saved(record, tmp_path)
    with np.load(path) as file:
        assert file["arms"].size == file["steps"].size == file["observation"].size == 0
    assert str(load_divergence(path).finding) == "value loss in update 4 of 4"


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        ({"what": None}, "it has no 'what'"),
        ({"what": np.array("charm")}, "other types, shapes or ranges"),
        ({"batch": np.array([1, 2])}, "only"),
        ({"batch": np.array(-1)}, "other types, shapes or ranges"),
        ({"metrics": np.zeros(3)}, "other types, shapes or ranges"),
        ({"metrics": np.zeros((3, len(TRACED)), np.int64)}, "other types, shapes or ranges"),
        ({"metrics": np.zeros((0, len(TRACED))), "what": np.array("action")}, "other types, shapes or ranges"),
        ({"bad_arms": np.zeros(3)}, "other types, shapes or ranges"),
        ({"index": np.array(np.inf)}, "infinity"),
        ({"index": np.array(9)}, "other types, shapes or ranges"),
    ],
)
def test_other_files_are_rejected(record, tmp_path, change, reason):
    record.trace.metrics[3, 0] = np.nan
    with np.load(saved(record, tmp_path)) as file:
        arrays = {name: value for name, value in {**file, **change}.items() if value is not None}
    np.savez(tmp_path / "other.npz", **arrays)
    with pytest.raises(ValueError, match=f"other.npz' is no file of a training that diverged: .*{reason}") as error:
        load_divergence(tmp_path / "other.npz")
    assert "\n" not in str(error.value)


def test_a_failure_is_a_warning(tmp_path, capsys):
    def fail():
        raise RuntimeError("out of\nmemory")

    assert record_divergence(tmp_path, fail, Epoch(100, 3, STATE)) is None
    shown = capsys.readouterr()
    assert shown.out == "training diverged: looking for the first of 3 batches after 100 steps that is not finite\n"
    assert shown.err == "warning: the batch that is not finite cannot be recorded: RuntimeError: out of memory\n"
    assert not list(tmp_path.iterdir())


def test_a_file_that_cannot_be_written_leaves_no_part(record, tmp_path, monkeypatch):
    record.trace.metrics[3, 0] = np.nan

    def full(file, **arrays):
        file.write(b"half")
        raise OSError("No space left on device")

    monkeypatch.setattr(divergence.np, "savez", full)
    with pytest.raises(OSError, match="No space left"):
        saved(record, tmp_path)
    assert not list(tmp_path.iterdir())
