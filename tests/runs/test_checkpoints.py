"""Checkpoints: written whole, verified, thinned."""

import json
import os
import re
import shutil
import subprocess
import sys

import jax
import numpy as np
import orbax.checkpoint as ocp
import pytest

from mimic.runs import checkpoints
from mimic.runs.checkpoints import (
    check_checkpoint,
    checkpoint_steps,
    delete_partial_checkpoints,
    load_checkpoint,
    load_training,
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


@pytest.mark.parametrize("name", ["layer.kernel/0.0", "training.npz", "_METADATA", "checkpoint.json"])
def test_a_damaged_last_checkpoint_is_replaced_by_the_one_before(run_dir, name, capsys):
    file = run_dir / "checkpoints" / "000000000020" / name
    content = bytearray(file.read_bytes())
    content[len(content) // 2] ^= 0x55
    file.write_bytes(content)
    assert load_training(run_dir, PARAMS).step == 10
    warning = capsys.readouterr().err
    assert warning.count("\n") == 1 and "000000000020' is damaged" in warning and "the checkpoint before it" in warning
    assert check_checkpoint(run_dir) == 10
    with pytest.raises(ValueError, match="is damaged"):
        load_checkpoint(run_dir, PARAMS, 20)


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


@pytest.mark.parametrize("content", ["[]", "3", '{"sha256": []}', '{"metrics": 1}'])
def test_other_json_is_noticed(run_dir, content):
    (run_dir / "checkpoints" / "000000000020" / "checkpoint.json").write_text(content)
    assert load_training(run_dir, PARAMS).step == 10


def test_orbax_default_format_is_read(tmp_path):
    """Runs of mimic 0.1 have it."""
    with ocp.StandardCheckpointer() as checkpointer:
        checkpointer.save(tmp_path / "checkpoints" / "000000000030", PARAMS)
    step, params = load_checkpoint(tmp_path, PARAMS)
    assert step == 30
    np.testing.assert_array_equal(params["layer"]["kernel"], PARAMS["layer"]["kernel"])


def test_a_save_prints_nothing(tmp_path):
    """Orbax warns of its own formats."""
    program = (
        "import sys; from pathlib import Path; from mimic.runs.checkpoints import *\n"
        "save_checkpoint(Path(sys.argv[1]), 0, {'a': 1.0})"
    )
    run = subprocess.run([sys.executable, "-c", program, str(tmp_path)], capture_output=True, text=True, check=True)
    assert (run.stdout, run.stderr) == ("", "")


@pytest.mark.slow
def test_memory_is_flat_over_saves(tmp_path):
    """OCDBT, orbax's default, keeps 3 to 4 kB at each save."""
    program = (
        "import sys, numpy as np; from pathlib import Path; from mimic.runs.checkpoints import *\n"
        "folder = Path(sys.argv[1])\n"
        "params = {f'layer_{i}': {'kernel': np.ones((8, 8)), 'bias': np.ones(8)} for i in range(4)}\n"
        "for step in range(2000):\n"
        "    save_checkpoint(folder, step, params); thin_checkpoints(folder, 2)\n"
        "    if step % 200 == 199: print(Path('/proc/self/statm').read_text().split()[1])"
    )
    run = subprocess.run([sys.executable, "-c", program, str(tmp_path)], capture_output=True, text=True, check=True)
    pages = [int(line) for line in run.stdout.split()]
    growth = 4 * np.diff(pages) / 200  # kB at each save
    assert np.median(growth) < 1.5  # 0.1 to 0.4; the allocator may once take 2 MB at a time


def test_a_missing_file_is_noticed(run_dir):
    shutil.rmtree(run_dir / "checkpoints" / "000000000020" / "layer.kernel")
    assert check_checkpoint(run_dir) == 10


def test_a_checkpoint_of_another_run_is_rejected(run_dir, tmp_path_factory, capsys):
    other = tmp_path_factory.mktemp("other")
    save_checkpoint(other, 30, PARAMS)
    shutil.copytree(other / "checkpoints" / "000000000030", run_dir / "checkpoints" / "000000000030")
    assert load_checkpoint(run_dir, PARAMS)[0] == 20
    assert "is that of another run" in capsys.readouterr().err


def test_no_undamaged_checkpoint_is_an_error(run_dir):
    for step in checkpoint_steps(run_dir):
        (run_dir / "checkpoints" / f"{step:012d}" / "_METADATA").unlink()
    with pytest.raises(ValueError, match="000000000000' is damaged: _METADATA is missing or was changed"):
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


def test_a_checkpoint_of_an_earlier_version_is_read(tmp_path):
    """It is orbax's folder alone."""
    with ocp.StandardCheckpointer() as checkpointer:
        checkpointer.save(tmp_path / "checkpoints" / f"{5:012d}", PARAMS)
    assert load_training(tmp_path, PARAMS)[2:] == (None, {})
    (tmp_path / "checkpoints" / f"{5:012d}" / "_METADATA").unlink()
    with pytest.raises(ValueError, match="cannot be read: a file is missing"):
        load_checkpoint(tmp_path, PARAMS)


def test_another_network_is_named(run_dir):
    other = {"layer": {**PARAMS["layer"], "kernel": np.zeros((2, 4), np.float32)}}
    with pytest.raises(ValueError, match=r"layer.kernel: expected shape \(2, 4\), got shape \(2, 3\)\)"):
        load_checkpoint(run_dir, other)


def test_old_checkpoints_are_thinned(run_dir):
    save_checkpoint(run_dir, 30, PARAMS, STATE)
    thin_checkpoints(run_dir, keep=3, best=0)
    assert checkpoint_steps(run_dir) == [0, 10, 20, 30]
    thin_checkpoints(run_dir, keep=3)
    assert checkpoint_steps(run_dir) == [10, 20, 30]
    has_state = [(run_dir / "checkpoints" / f"{step:012d}" / "training.npz").is_file() for step in (10, 20, 30)]
    assert has_state == [False, True, True]
    assert load_checkpoint(run_dir, PARAMS, 10)[0] == 10  # the checksum of the removed state is not expected


def test_a_failed_write_changes_nothing(run_dir, monkeypatch):
    before = sorted(path.name for path in (run_dir / "checkpoints").rglob("*"))

    def full(*_, **__):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(checkpoints.np, "savez", full)
    with pytest.raises(OSError, match="000000000030' cannot be written: .*No space left on device"):
        save_checkpoint(run_dir, 30, PARAMS, STATE)
    assert sorted(path.name for path in (run_dir / "checkpoints").rglob("*")) == before


@pytest.mark.parametrize("limit", [100, 2000])
def test_a_full_disk_is_one_error(tmp_path, limit):
    """In a process that may not write files above a size, as on a full disk, for orbax too."""
    script = f"""
import resource, signal, sys
from pathlib import Path
import numpy as np
from mimic.runs.checkpoints import checkpoint_steps, save_checkpoint
run_dir = Path(sys.argv[1])
params = {{"kernel": np.random.default_rng(0).normal(size=(300, 300))}}
save_checkpoint(run_dir, 0, params)
signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
resource.setrlimit(resource.RLIMIT_FSIZE, ({limit}, {limit}))
try:
    save_checkpoint(run_dir, 1, params, [np.zeros(3)])
except OSError as error:
    assert "cannot be written" in str(error), error
    assert checkpoint_steps(run_dir) == [0]
    print("one error")
"""
    ended = subprocess.run([sys.executable, "-c", script, tmp_path], capture_output=True, text=True, check=False)
    assert ended.returncode == 0 and ended.stdout == "one error\n", ended.stderr[-2000:]


def test_partial_checkpoints_are_no_checkpoints(run_dir):
    whole = run_dir / "checkpoints" / "000000000020"
    for name in ("000000000030.partial", "000000000030.partial.orbax-checkpoint-tmp"):
        shutil.copytree(whole, whole.with_name(name))
    assert checkpoint_steps(run_dir) == [0, 10, 20]
    delete_partial_checkpoints(run_dir)
    assert {path.name for path in (run_dir / "checkpoints").iterdir()} == {
        *(f"{step:012d}" for step in (0, 10, 20)),
        "run_id",
    }


def test_a_step_is_written_anew_only_after_it_was_damaged(run_dir):
    folder = run_dir / "checkpoints" / "000000000020"
    run = json.loads((folder / "checkpoint.json").read_text())["run"]
    os.truncate(folder / "training.npz", 10)
    assert load_training(run_dir, PARAMS).step == 10
    save_checkpoint(run_dir, 20, PARAMS, STATE)
    assert load_training(run_dir, PARAMS).step == 20
    assert json.loads((folder / "checkpoint.json").read_text())["run"] == run
