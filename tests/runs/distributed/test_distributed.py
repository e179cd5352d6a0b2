"""Training over several processes: one run directory, and no process left running however it ends."""

import contextlib
import json
import os
import pathlib
import re
import signal
import subprocess
import sys
import threading
import time

import jax
import pytest

from mimic import train
from mimic.commands import cli
from mimic.runs.distributed import process_group
from mimic.runs.distributed.local_processes import LocalProcess, LocalProcesses, local_process
from mimic.runs.distributed.process_group import DistributedConfig, ProcessGroup
from tests.helpers.commands import command, free_port, schemas, wait_for
from tests.helpers.commands import start as start_command
from tests.helpers.tiny import ENDLESS, TINY


def start(tmp_path, *arguments, slurm=False):
    """Starts two processes of one training, each with its own CPU device."""
    port, processes = free_port(), []
    for index in range(2):
        environment = {**os.environ, "JAX_PLATFORMS": "cpu"}
        found = [f"distributed.coordinator=127.0.0.1:{port}", "distributed.processes=2", f"distributed.process={index}"]
        if slurm:  # what srun tells its tasks; JAX makes the port of the job's number
            found = ["distributed.coordinator=auto"]
            environment |= {"SLURM_JOB_ID": str(port), "SLURM_STEP_NODELIST": "localhost", "SLURM_NTASKS": "2"}
            environment |= {"SLURM_PROCID": str(index), "SLURM_LOCALID": str(index)}
        options = {"stderr": subprocess.STDOUT, "env": environment, "cwd": tmp_path}
        processes.append(start_command("train", *TINY, *found, *arguments, **options))
    return processes


def finish(processes):
    """Exit code and output of each process; none may hang."""
    try:
        outputs = [process.communicate(timeout=280)[0] for process in processes]
    finally:
        for process in processes:
            process.kill()
    return [(process.returncode, output) for process, output in zip(processes, outputs, strict=True)]


@pytest.mark.slow
def test_two_processes_make_one_run_that_one_process_continues(tmp_path):
    (first, shown), (second, silent) = finish(start(tmp_path, "run_dir=run"))
    assert (first, second) == (0, 0), shown[-2000:] + silent[-2000:]
    report = json.loads((tmp_path / "run" / "report.json").read_text())
    assert report["env_steps"] >= 5000
    assert (report["hardware"]["devices"], report["hardware"]["processes"]) == (2, 2)
    assert len((tmp_path / "run" / "metrics.csv").read_text().splitlines()) == 1 + 4
    assert [path.name for path in tmp_path.iterdir()] == ["run"]
    assert "results: run" in shown and "results" not in silent
    # Another number of processes goes on with it; here, one.
    result = command("train", "resume=run", "trainer.num_timesteps=8000", "trainer.evaluations=1", cwd=tmp_path)
    assert result.returncode == 0, result.stderr[-2000:]
    assert json.loads((tmp_path / "run" / "report.json").read_text())["env_steps"] >= 8000


@pytest.mark.slow
def test_the_variables_of_slurm_are_enough(tmp_path):
    (first, shown), (second, silent) = finish(start(tmp_path, "run_dir=run", "trainer.evaluations=1", slurm=True))
    assert (first, second) == (0, 0), shown[-2000:] + silent[-2000:]
    assert json.loads((tmp_path / "run" / "report.json").read_text())["hardware"]["processes"] == 2


def alone(tmp_path, *arguments):
    """One command that starts the other process itself."""
    environment = {**os.environ, "JAX_PLATFORMS": "cpu"}
    options = {"stderr": subprocess.STDOUT, "env": environment, "cwd": tmp_path}
    return start_command("train", *TINY, "distributed.coordinator=local", *arguments, **options)


def wait_for_checkpoint(tmp_path, processes):
    wait_for(tmp_path, "run/checkpoints/0*[1-9]*", *processes)


def started_by(process):
    """Ids of the running processes of the training that it started."""
    children = pathlib.Path(f"/proc/{process.pid}/task/{process.pid}/children").read_text().split()
    told = {child: pathlib.Path(f"/proc/{child}/environ") for child in children}
    return [int(child) for child, given in told.items() if given.exists() and b"MIMIC_LOCAL" in given.read_bytes()]


def there(process):
    with contextlib.suppress(ProcessLookupError):
        os.kill(process, 0)
        return True
    return False


@pytest.mark.slow
def test_one_command_starts_all_processes_of_a_host(tmp_path):
    """On MJX, which JAX once rejected in several processes; the others train on the fused physics."""
    found = ["distributed.processes=2", "env.physics=mjx"]
    ((code, shown),) = finish([alone(tmp_path, *found, "run_dir=run")])
    assert code == 0, shown[-2000:]
    report = json.loads((tmp_path / "run" / "report.json").read_text())
    assert (report["hardware"]["devices"], report["hardware"]["processes"]) == (2, 2)
    assert [path.name for path in tmp_path.iterdir()] == ["run"]


@pytest.mark.slow
def test_ctrl_c_ends_all_that_one_command_started(tmp_path):
    process = alone(tmp_path, "distributed.processes=2", "run_dir=run", *ENDLESS)
    wait_for_checkpoint(tmp_path, [process])
    (other,) = started_by(process)
    process.send_signal(signal.SIGINT)
    ((code, shown),) = finish([process])
    assert code == 128 + signal.SIGINT, shown[-2000:]
    assert shown.count("stopping at the next checkpoint") == 1 and "resume=run" in shown
    assert not there(other)


@pytest.mark.slow
@pytest.mark.parametrize("early", [False, True])
def test_one_command_ends_if_a_process_of_it_is_lost(tmp_path, early):
    """Early: before they are connected."""
    process = alone(tmp_path, "distributed.processes=2", "run_dir=run", *ENDLESS)
    if not early:
        wait_for_checkpoint(tmp_path, [process])
    while not started_by(process):
        time.sleep(0.1)
    (other,) = started_by(process)
    os.kill(other, signal.SIGKILL)
    ((code, shown),) = finish([process])
    assert code == 1 and "error: process 1 of the training failed" in shown, shown[-2000:]
    assert "ended by signal 9" in shown


@pytest.mark.slow
@pytest.mark.parametrize(
    ("number", "lost", "line"),
    [
        (signal.SIGKILL, 0, "another task died"),
        (signal.SIGKILL, 1, "error: another process of the training is lost"),
        (signal.SIGSTOP, 0, "another task died"),
    ],
)
def test_the_others_end_if_one_is_stopped_or_killed(tmp_path, number, lost, line):
    processes = start(tmp_path, "run_dir=run", *ENDLESS)
    wait_for_checkpoint(tmp_path, processes)
    os.kill(processes[lost].pid, number)
    other = processes[1 - lost]
    try:
        shown = other.communicate(timeout=100)[0]
    finally:
        for process in processes:
            process.kill()
            process.wait()
    assert other.returncode not in (0, None) and shown.count(line) == 1, shown
    assert "Traceback" not in shown


@pytest.mark.slow
def test_input_that_both_processes_reject_is_one_line(tmp_path):
    process = alone(tmp_path, "distributed.processes=3", "run_dir=run")
    ((code, shown),) = finish([process])
    assert code == 2 and shown.count("expected a multiple of") == 1, shown


def test_each_started_process_knows_its_place(monkeypatch):
    """Each is the same command; what it says last is kept, and it is killed if it does not end."""
    program = "import sys; from mimic.runs.distributed.local_processes import local_process;"
    program += " print('x' * 3000, local_process(), file=sys.stderr)"
    monkeypatch.setattr(sys, "orig_argv", ["python", "-c", program])
    others = LocalProcesses(3)
    assert others.ended_at_start() is None
    others.end(patience_s=60)
    for index in (1, 2):
        output = others.error_output(index)
        assert output.startswith("xx") and len(output) <= 2000
        assert output.endswith(str(LocalProcess(others.address, 3, index, os.getpid())))
    monkeypatch.setattr(sys, "orig_argv", ["python", "-c", "import time; time.sleep(100)"])
    others = LocalProcesses(3)
    assert others.first_ended() is None and others.error_output(1) == ""
    others.end(patience_s=0)
    assert others.first_ended() == others.ended_at_start() == 1
    assert others.error_output(1) == "ended by signal 9 (Killed)"


def test_a_process_that_was_not_started_is_the_first(monkeypatch):
    monkeypatch.delenv("MIMIC_LOCAL_PROCESS", raising=False)
    assert local_process() is None


def test_a_process_ends_with_the_first_one(monkeypatch):
    monkeypatch.setattr(sys, "platform", "none")  # this process goes on
    monkeypatch.setenv("MIMIC_LOCAL_PROCESS", "127.0.0.1:1 2 1 1")
    monkeypatch.setattr(os, "getppid", lambda: 2)
    with pytest.raises(SystemExit):
        local_process()


@pytest.mark.parametrize(
    ("asked", "gpus", "platforms", "expected"),
    [
        (None, 4, "", 4),
        (2, 4, "", 2),
        (2, 0, "", 2),
        (8, 4, "cpu", 8),
        (8, 4, "", "expected at most 4"),
        (None, 0, "", "expected a number"),
    ],
)
def test_there_is_a_gpu_for_each_process_of_a_host(monkeypatch, asked, gpus, platforms, expected):
    monkeypatch.setattr(process_group, "gpu_count", lambda: gpus)
    monkeypatch.setenv("JAX_PLATFORMS", platforms)
    if isinstance(expected, int):
        assert process_group.processes_here(asked) == expected
    else:
        with pytest.raises(ValueError, match=f"distributed.processes: {expected}"):
            process_group.processes_here(asked)


@pytest.mark.slow
def test_a_signal_to_one_process_stops_all_after_a_checkpoint(tmp_path):
    processes = start(tmp_path, "run_dir=run", *ENDLESS)
    wait_for_checkpoint(tmp_path, processes)
    processes[1].send_signal(signal.SIGTERM)
    (first, shown), (second, _) = finish(processes)
    assert (first, second) == (128 + signal.SIGTERM, 128 + signal.SIGTERM), shown[-2000:]
    assert "resume=run" in shown


@pytest.mark.slow
def test_a_process_with_bad_input_ends_the_others(tmp_path):
    (tmp_path / "run" / "results").mkdir(parents=True)
    (first, shown), (second, silent) = finish(start(tmp_path, "run_dir=run"))
    assert first == 2 and "'run' exists" in shown
    assert second == 1 and "error: process 0 of the training failed" in silent


@pytest.mark.parametrize(
    "settings, reason",
    [
        ({"coordinator": "host"}, "expected HOST:PORT, auto or local, got 'host'"),
        ({"coordinator": "host:1", "processes": 2}, "distributed.process: expected a number"),
        ({"coordinator": "host:1", "process": 0}, "distributed.processes: expected a number"),
        ({"coordinator": "host:1", "processes": 2, "process": 2}, "distributed.process: expected 0 to 1, got 2"),
        (
            {"coordinator": "host:1", "processes": 0, "process": 0},
            "processes: expected a whole number from 1 to",
        ),
        ({"process": 1}, "distributed.process: not expected, got 1 with distributed.coordinator=''"),
        ({"coordinator": "auto", "processes": 2}, "distributed.processes: not expected"),
        ({"coordinator": "local", "processes": 2, "process": 0}, "distributed.process: not expected"),
        (
            {"coordinator": "local", "processes": 0},
            "processes: expected a whole number from 1 to",
        ),
    ],
)
def test_bad_settings_are_rejected(settings, reason):
    with pytest.raises(ValueError, match=reason):
        DistributedConfig(**settings)


def test_a_distributed_sweep_is_rejected(tmp_path, monkeypatch, capsys):
    alone = ["distributed.coordinator=localhost:1", "distributed.processes=1", "distributed.process=0"]
    monkeypatch.setattr(cli, "schema", schemas)
    monkeypatch.setattr(sys, "argv", ["mimic.train", "-m", *alone, "seed=0,1", f"hydra.sweep.dir={tmp_path}/sweep"])
    with pytest.raises(SystemExit) as stop:
        cli.run(train.prepare, "train")
    assert stop.value.code == 1
    assert len(re.findall("^failed: .*expected one run, got a sweep", capsys.readouterr().err, re.MULTILINE)) == 2


class Ended(BaseException):
    """Instead of the end of this process."""


@pytest.fixture
def group(monkeypatch):
    """Makes a group whose coordination service is a dictionary; what ends the process is recorded in `codes`."""
    monkeypatch.setattr(process_group, "_POLL_S", 0.01)
    monkeypatch.setattr(process_group, "_GRACE_S", 0.0)
    monkeypatch.setattr(process_group, "EXIT_HOOKS", [])
    monkeypatch.setattr(process_group.atexit, "register", lambda *_: None)
    monkeypatch.setattr(process_group, "_disconnect", lambda: client.ended.append(True))
    monkeypatch.setattr(process_group.compat, "coordination_client", lambda: client)
    client, groups = Client(), []

    def end(code):
        client.codes.append(code)
        for group in groups:
            group._left.set()
        if threading.current_thread() is threading.main_thread():
            raise Ended

    monkeypatch.setattr(process_group, "_exit", end)

    def make(index):
        groups.append(ProcessGroup(index))
        return groups[-1], client

    yield make
    for group in groups:
        group._left.set()


class Client:
    """The coordination service's keys: each is set once."""

    def __init__(self):
        self.keys, self.codes, self.ended = {}, [], []

    def key_value_set(self, key, value):
        if key in self.keys:
            raise jax.errors.JaxRuntimeError("exists")
        self.keys[key] = value

    def key_value_try_get(self, key):
        if key not in self.keys:
            raise jax.errors.JaxRuntimeError("not found")
        return self.keys[key]


@pytest.mark.parametrize(
    ("exit_code", "line"), [(0, ""), (1, "error: process 0 of the training failed\n"), (128 + signal.SIGTERM, "")]
)
def test_a_process_ends_as_the_first_one_announces(group, capsys, exit_code, line):
    second, client = group(1)
    client.key_value_set(process_group._ENDED, f"0 {exit_code}")
    second.wait()
    assert client.codes == [exit_code] and capsys.readouterr().err == line


def test_the_first_process_learns_of_the_signal_of_another(group):
    first, client = group(0)
    second, _ = group(1)
    second.signals.caught.append(signal.SIGTERM)
    until = time.monotonic() + 60
    while not first.signals.caught and time.monotonic() < until:
        time.sleep(0.01)
    assert first.signals.caught == [signal.SIGTERM] and client.codes == []


def test_the_end_is_announced_once(group):
    first, client = group(0)
    for code in (0, 1):
        first.end(code)
    assert client.keys == {process_group._ENDED: "0 0"} and len(client.ended) == 1


def test_a_broken_connection_is_one_line_and_another_error_a_traceback(group, capsys):
    first, client = group(0)

    def fail(reason):
        raise jax.errors.JaxRuntimeError(reason)

    with pytest.raises(jax.errors.JaxRuntimeError, match="out of memory"):
        first.run(lambda: fail("out of memory"))
    assert capsys.readouterr().err == "" and client.codes == []
    with pytest.raises(Ended):
        first.run(lambda: fail("UNKNOWN: Gloo all-reduce failed:\nConnection reset by peer"))
    assert client.codes == [1] and client.keys == {process_group._ENDED: "0 1"}
    error = capsys.readouterr().err
    assert error.startswith("error: another process of the training is lost: UNKNOWN: Gloo") and error.count("\n") == 1
    assert first.run(lambda: 7) == 7
