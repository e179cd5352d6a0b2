"""Checkpoints: written whole, verified, thinned."""

import hashlib
import json
import os
import re
import resource
import shutil
import signal

import jax
import numpy as np
import pytest

from mimic.runs import checkpoints
from mimic.runs.checkpoints import (
    DamagedCheckpoint,
    check_checkpoint,
    checkpoint_steps,
    delete_partial_checkpoints,
    load_checkpoint,
    load_training,
    mark_damaged_after,
    save_checkpoint,
    thin_checkpoints,
)

PARAMS = {"layer": {"kernel": np.arange(6, dtype=np.float32).reshape(2, 3), "bias": np.ones(3, np.float32)}}
STATE = [np.arange(4, dtype=np.uint32), np.array([[1.5, -0.0]], np.float32), np.array(7)]


@pytest.fixture
def run_dir(tmp_path):
    """A run with checkpoints of three steps, which differ."""
    for step in (0, 10, 20):
        params = {"layer": {**PARAMS["layer"], "bias": np.full(3, step, np.float32)}}
        save_checkpoint(tmp_path, step, params, [*STATE, np.array(step)], {"loss": 0.5 * step} if step else {})
    return tmp_path


def test_a_checkpoint_is_read_as_it_was_written(run_dir):
    step, params, state, metrics = load_training(run_dir, PARAMS)
    assert (step, metrics) == (20, {"loss": 10.0})
    np.testing.assert_array_equal(params["layer"]["kernel"], PARAMS["layer"]["kernel"])
    assert state is not None
    for value, expected in zip(state, [*STATE, np.array(20)], strict=True):
        assert value.dtype == expected.dtype and value.tobytes() == expected.tobytes()


def test_each_flipped_bit_is_noticed(run_dir):
    """Numbers of a checkpoint without checksums can change without an error."""
    folder = run_dir / "checkpoints" / "000000000020"
    rng = np.random.default_rng(0)
    for file in [file for file in folder.rglob("*") if file.is_file() and file.stat().st_size]:
        original = file.read_bytes()
        for position in rng.integers(0, len(original), 8):
            changed = bytearray(original)
            changed[position] ^= 1 << int(rng.integers(8))
            file.write_bytes(changed)
            try:
                step, params = load_checkpoint(run_dir, PARAMS)
            except ValueError:
                continue  # "run" in checkpoint.json, say
            if step == 20:  # a change of checkpoint.json that means the same
                np.testing.assert_array_equal(params["layer"]["bias"], np.full(3, 20))
                assert file.name == "checkpoint.json"
        file.write_bytes(original)
    assert load_checkpoint(run_dir, PARAMS)[0] == 20


def write_arrays(folder, **arrays):
    """Writes other parameters, with the checksum that they need."""
    np.savez(folder / "params.npz", **arrays)
    sign(folder, "params.npz")


def sign(folder, name):
    content = json.loads((folder / "checkpoint.json").read_text())
    content["sha256"][name] = hashlib.sha256((folder / name).read_bytes()).hexdigest()
    (folder / "checkpoint.json").write_text(json.dumps(content))


ARRAYS = {"layer/kernel": PARAMS["layer"]["kernel"], "layer/bias": PARAMS["layer"]["bias"]}
DAMAGES = {
    "no parameters": (lambda folder: (folder / "params.npz").unlink(), "is damaged: params.npz is missing"),
    "cut parameters": (lambda folder: os.truncate(folder / "params.npz", 300), "is damaged: params.npz was changed"),
    "cut state": (lambda folder: os.truncate(folder / "training.npz", 300), "is damaged: training.npz was changed"),
    "no content": (lambda folder: (folder / "checkpoint.json").unlink(), "is damaged: checkpoint.json is missing"),
    "bad JSON": (lambda folder: (folder / "checkpoint.json").write_text("{"), "checkpoint.json cannot be read: Expect"),
    "no object": (lambda folder: (folder / "checkpoint.json").write_text("[]"), "cannot be read: expected an object"),
    "no keys": (lambda folder: (folder / "checkpoint.json").write_text("{}"), "checkpoint.json cannot be read: 'run'"),
    "other values": (
        lambda folder: (folder / "checkpoint.json").write_text(
            '{"run": "", "metrics": {"a": "b"}, "made_with": {}, "sha256": {}}'
        ),
        "checkpoint.json cannot be read: metrics: unexpected value",
    ),
    "signed, cut": (
        lambda folder: (os.truncate(folder / "params.npz", 300), sign(folder, "params.npz")),
        "params.npz cannot be read: it is no zip archive",
    ),
    "signed, objects": (
        lambda folder: write_arrays(folder, **{**ARRAYS, "layer/bias": np.array([None], object)}),
        "params.npz cannot be read: layer/bias has type object",
    ),
    "signed, not finite": (
        lambda folder: write_arrays(folder, **{**ARRAYS, "layer/bias": np.array([0, np.nan, 0], np.float32)}),
        "params.npz cannot be read: layer/bias: expected finite numbers",
    ),
}
OTHERS = {
    "shape": (
        {**ARRAYS, "layer/kernel": np.zeros((2, 4), np.float32)},
        r"layer/kernel: expected shape \(2, 3\), got shape \(2, 4\)\)",
    ),
    "type": (
        {**ARRAYS, "layer/bias": np.zeros(3)},
        r"layer/bias: expected type float32, got type float64\)",
    ),
    "less": ({"layer/bias": ARRAYS["layer/bias"]}, "layer/kernel: expected shape .*, got no such array"),
    "more": ({**ARRAYS, "layer/z": np.zeros(2)}, "layer/z: expected no such array, got an array"),
}


@pytest.mark.parametrize(("damage", "reason"), DAMAGES.values(), ids=DAMAGES)
def test_a_damaged_checkpoint_is_one_line_and_the_one_before_is_used(run_dir, damage, reason, capsys):
    damage(run_dir / "checkpoints" / "000000000020")
    with pytest.raises(DamagedCheckpoint, match=reason) as error:
        load_checkpoint(run_dir, PARAMS, 20)
    assert "000000000020'" in str(error.value) and "\n" not in str(error.value)
    assert load_training(run_dir, PARAMS).step == 10
    warning = capsys.readouterr().err
    assert warning.count("\n") == 1 and "the checkpoint before it is used" in warning


@pytest.mark.parametrize(("arrays", "reason"), OTHERS.values(), ids=OTHERS)
def test_parameters_of_another_network_are_named(run_dir, arrays, reason):
    """No earlier checkpoint is used: all of the run have that network."""
    write_arrays(run_dir / "checkpoints" / "000000000020", **arrays)
    with pytest.raises(ValueError, match="it has other arms or another network \\(" + reason) as error:
        load_training(run_dir, PARAMS)
    assert not isinstance(error.value, DamagedCheckpoint)


def test_a_damaged_state_is_one_line(run_dir):
    folder = run_dir / "checkpoints" / "000000000020"
    os.truncate(folder / "training.npz", 100)
    sign(folder, "training.npz")
    with pytest.raises(DamagedCheckpoint, match="training.npz cannot be read: it is no zip archive"):
        load_training(run_dir, PARAMS)


def test_a_checkpoint_of_another_run_is_rejected(run_dir, tmp_path_factory, capsys):
    other = tmp_path_factory.mktemp("other")
    save_checkpoint(other, 30, PARAMS)
    shutil.copytree(other / "checkpoints" / "000000000030", run_dir / "checkpoints" / "000000000030")
    assert load_checkpoint(run_dir, PARAMS)[0] == 20
    assert "is that of another run" in capsys.readouterr().err


def test_no_undamaged_checkpoint_is_an_error(run_dir):
    for step in checkpoint_steps(run_dir):
        (run_dir / "checkpoints" / f"{step:012d}" / "params.npz").unlink()
    with pytest.raises(ValueError, match="000000000000' is damaged: params.npz is missing"):
        load_checkpoint(run_dir, PARAMS)


def test_another_device_is_said(run_dir, monkeypatch, capsys):
    load_training(run_dir, PARAMS)
    assert capsys.readouterr().err == ""
    monkeypatch.setattr(checkpoints, "_software_and_devices", lambda: {"device": "1 x other", "jax": jax.__version__})
    assert load_training(run_dir, PARAMS).step == 20
    assert re.fullmatch(
        r"warning: the run was trained with device \d+ x cpu, now it is 1 x other: .*last bits\n",
        capsys.readouterr().err,
    )


def test_a_missing_training_state_is_one_line(run_dir, capsys):
    (run_dir / "checkpoints" / "000000000020" / "training.npz").unlink()
    restored, warning = load_training(run_dir, PARAMS), capsys.readouterr().err
    assert (restored.step, restored.state) == (20, None)
    assert warning.count("\n") == 1 and "000000000020' has no training.npz: training continues" in warning


def test_old_checkpoints_are_thinned(run_dir):
    save_checkpoint(run_dir, 30, PARAMS, STATE)
    thin_checkpoints(run_dir, keep=3, best=0)
    assert checkpoint_steps(run_dir) == [0, 10, 20, 30]
    thin_checkpoints(run_dir, keep=3)
    assert checkpoint_steps(run_dir) == [10, 20, 30]
    has_state = [(run_dir / "checkpoints" / f"{step:012d}" / "training.npz").is_file() for step in (10, 20, 30)]
    assert has_state == [False, True, True]
    assert load_checkpoint(run_dir, PARAMS, 10)[0] == 10  # the checksum of the removed state is not expected


def test_a_full_disk_is_one_error(run_dir):
    """By the maximum size of a file of this process."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    ignored = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    try:
        for limit in (100, 2000):
            resource.setrlimit(resource.RLIMIT_FSIZE, (limit, before[1]))
            with pytest.raises(OSError, match="000000000030' cannot be written: .*File too large"):
                save_checkpoint(run_dir, 30, {"kernel": np.zeros((300, 300))}, STATE)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
        signal.signal(signal.SIGXFSZ, ignored)
    assert {path.name for path in (run_dir / "checkpoints").iterdir()} == {
        "run_id",
        *(f"{i:012d}" for i in (0, 10, 20)),
    }


def test_partial_checkpoints_are_no_checkpoints(run_dir):
    whole = run_dir / "checkpoints" / "000000000020"
    shutil.copytree(whole, whole.with_name("000000000030.partial"))
    assert checkpoint_steps(run_dir) == [0, 10, 20]
    delete_partial_checkpoints(run_dir)
    assert {path.name for path in (run_dir / "checkpoints").iterdir()} == {
        *(f"{step:012d}" for step in (0, 10, 20)),
        "run_id",
    }


def test_damaged_checkpoints_are_renamed(run_dir):
    for _ in range(2):  # a step may be damaged again
        mark_damaged_after(run_dir, 10)
        assert checkpoint_steps(run_dir) == [0, 10]
        assert (run_dir / "checkpoints" / "000000000020.damaged" / "params.npz").is_file()
        save_checkpoint(run_dir, 20, PARAMS)


def test_a_step_is_written_anew_only_after_it_was_damaged(run_dir):
    folder = run_dir / "checkpoints" / "000000000020"
    run = json.loads((folder / "checkpoint.json").read_text())["run"]
    os.truncate(folder / "training.npz", 10)
    assert load_training(run_dir, PARAMS).step == check_checkpoint(run_dir) == 10
    save_checkpoint(run_dir, 20, PARAMS, STATE)
    assert load_training(run_dir, PARAMS).step == 20
    assert json.loads((folder / "checkpoint.json").read_text())["run"] == run
