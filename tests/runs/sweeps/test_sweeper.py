"""Sweeps: their runs and launchers, failed runs, and signals."""

import contextlib
import json
import os
import pathlib
import signal
import stat
import sys
import threading
import time

import pytest
from hydra.core.utils import JobReturn, JobStatus
from hydra.errors import HydraException

from mimic import train
from mimic.base.overrides import setting
from mimic.commands import cli
from mimic.runs.sweeps.launchers import gpus_of
from mimic.runs.sweeps.run_command import RunCommand
from mimic.runs.sweeps.sweeper import Outcome, Sweeper, path_of
from tests.helpers.commands import command, schemas, start, wait_for
from tests.helpers.run_directories import write_run
from tests.helpers.tiny import ENDLESS, TINY

# What Slurm would do, by the same commands: an array of jobs, each of which starts its step.
SBATCH = """#!/bin/bash
file="${@: -1}"
cp "$file" "$SLURM_STAND_IN/submitted.sh"
last=$(sed -nE 's/^#SBATCH --array=0-([0-9]+)%.*/\\1/p' "$file")
export SLURM_NTASKS=1 SLURM_JOB_NUM_NODES=1 SLURM_NODEID=0 SLURM_PROCID=0 SLURM_LOCALID=0 SLURM_ARRAY_JOB_ID=7
for i in $(seq 0 "$last"); do
  SLURM_JOB_ID=$((7 + i)) SLURM_ARRAY_TASK_ID=$i bash "$file" >/dev/null 2>&1 &
done
echo "Submitted batch job 7"
"""
SRUN = """#!/bin/bash
while [[ $1 == -* ]]; do [[ $1 == --output || $1 == --error ]] && shift; shift; done
exec "$@"
"""
SACCT = "#!/bin/bash\necho 'JobID|State|NodeList'\necho '7_0|RUNNING|here'\n"


@pytest.fixture
def slurm(tmp_path):
    """An environment with stand-ins of Slurm's commands."""
    programs = tmp_path / "bin"
    programs.mkdir()
    for name, text in {"sbatch": SBATCH, "srun": SRUN, "sacct": SACCT}.items():
        (programs / name).write_text(text)
        (programs / name).chmod(stat.S_IRWXU)
    return {**os.environ, "PATH": f"{programs}:{os.environ['PATH']}", "SLURM_STAND_IN": str(tmp_path)}


@pytest.mark.slow
# Any command can be swept, and this one is quick: collecting a folder with a run, and one that is not there.
@pytest.mark.parametrize("launcher", ["submitit_slurm", "submitit_local", "ray"])
def test_a_failed_run_is_named_and_the_rest_is_kept(launcher, tmp_path, slurm):
    if launcher == "ray":
        pytest.importorskip("ray")
    write_run(tmp_path / "there", [0.5])
    choice = [f"hydra/launcher={launcher}", "hydra.sweep.dir=sweep"]
    result = command("collect", "-m", "folder=missing,there", *choice, cwd=tmp_path, env=slurm)
    assert result.returncode == 1, result.stderr[-2000:]
    assert "sweep: 1 of 2 runs done; results: sweep" in result.stdout
    failures = [line for line in result.stderr.splitlines() if line.startswith("failed: ")]
    assert len(failures) == 1
    assert failures[0].startswith("failed: folder=missing: 'missing': there is no such folder")
    first, second = json.loads((tmp_path / "sweep" / "sweep.json").read_text())["runs"]
    assert (first["label"], first["exit_code"]) == ("folder=missing", 2)
    assert (second["label"], second["exit_code"]) == ("folder=there", 0)
    assert (tmp_path / "there" / "collected.csv").is_file()
    if launcher == "submitit_slurm":
        submitted = (tmp_path / "submitted.sh").read_text()
        for option in ("--time=60", "--gpus-per-node=1", "--cpus-per-task=8", "--signal=USR2@120", "--array=0-1%2"):
            assert f"#SBATCH {option}" in submitted


@pytest.mark.slow_for("arguments3-expected only with a sweep; add -m")
@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["-m", "env=panda5dof,panda4dof"], "unknown env 'panda5dof'; valid are"),
        (["-m", "seed=0,one"], "seed: expected a whole number, got 'one'"),
        (["-m", "hydra/launcher=slurm"], "unknown hydra/launcher 'slurm'; valid are basic, ray, submitit_local, submi"),
        (["hydra/launcher=submitit_local"], "expected only with a sweep; add -m"),
        (["-m", "hydra/launcher=submitit_local", "hydra.launcher.paralel=2"], "valid are _target_, parallel, gpus_per"),
        (
            ["-m", "hydra/launcher=submitit_local", "hydra.launcher.parallel=0"],
            "a whole number from 1 to 1,000, got 0",
        ),
        (
            ["-m", "seed=0,1", "run_dir=x"],
            "run_dir: expected a folder of its own for each run, got 'x' for 2 of them; hydra",
        ),
    ],
)
def test_bad_sweeps_write_nothing(rejected, arguments, message):
    assert message in rejected("train", *arguments)


def test_missing_slurm_and_packages_are_reported(rejected, monkeypatch):
    monkeypatch.setenv("PATH", "")
    assert "expected a machine with Slurm's sbatch" in rejected("train", "-m", "hydra/launcher=submitit_slurm")
    monkeypatch.setitem(sys.modules, "ray", None)
    os.rmdir(os.getcwd())
    assert "needs the package ray: pip install 'mimic-arms[ray]'" in rejected("train", "-m", "hydra/launcher=ray")


def test_a_folder_takes_one_sweep(rejected, tmp_path):
    (tmp_path / "sweep.json").write_text("{}")
    assert "has a sweep already" in rejected("train", "-m", "seed=0,1", f"hydra.sweep.dir={tmp_path}")


def test_the_same_sweep_continues(tmp_path, monkeypatch, capsys):
    launched = []

    class Launcher:
        def launch(self, job_overrides, initial_job_idx):
            launched.append(job_overrides)
            return [JobReturn(status=JobStatus.COMPLETED, _return_value=Outcome()) for _ in job_overrides]

    def setup(sweeper, *, hydra_context, task_function, config):
        sweeper.hydra_context, sweeper.config, sweeper.launcher = hydra_context, config, Launcher()

    def sweep(seeds):
        arguments = f"-m seed={seeds} hydra.sweep.dir={tmp_path}/sweep run_dir={tmp_path}/${{seed}}"
        monkeypatch.setattr(sys, "argv", ["mimic.train", *arguments.split()])
        cli.run(train.prepare, "train")

    monkeypatch.setattr(Sweeper, "setup", setup)
    monkeypatch.setattr(cli, "schema", schemas)
    sweep("0,1,2,3")
    write_run(tmp_path / "0", [0.5], seed=0)
    write_run(tmp_path / "1", [0.5], seed=1, report=False)
    (tmp_path / "1" / "checkpoints" / "000000001000").mkdir(parents=True)
    write_run(tmp_path / "2", [0.5], seed=2, report=False)
    sweep("0,1,2,3")
    assert [len(runs) for runs in launched] == [4, 3]
    resumed = [[f"resume={tmp_path}/{number}"] for number in (1, 2)]  # also the run without a checkpoint
    assert launched[1] == [*resumed, launched[0][3]]
    assert "4 of 4 runs done" in capsys.readouterr().out
    with pytest.raises(SystemExit):
        sweep("0,1")
    assert "has a sweep already, of other runs" in capsys.readouterr().err


@pytest.mark.parametrize("path", ["runs/a-b.c", "my runs/it's, a=b", "~/x"])
def test_the_path_of_a_run_is_read_from_its_override(path):
    assert path_of(setting("run_dir", path)) == path


@pytest.fixture
def program(tmp_path):
    """Makes a run of a program instead of the command."""

    def make(text, **more):
        (tmp_path / "program.py").write_text(text)
        return RunCommand("program", [], str(tmp_path), "log", **more)

    return make


WAITS = """
import pathlib, signal, sys, time
signal.signal(signal.SIGTERM, lambda *_: sys.exit(143))
pathlib.Path("began").touch()
time.sleep(60)
"""


def after_begin(folder, act):
    """Acts once the program has begun."""

    def wait():
        wait_for(folder, "began")
        act()

    threading.Thread(target=wait).start()


@pytest.mark.parametrize(
    ("text", "exit_code", "reason"),
    [
        ("print('fine')", 0, ""),
        ("import sys; print('so far', flush=True); sys.exit('error: no such arm')", 1, "no such arm; log: log"),
        ("raise ValueError('broken')", 1, "ValueError: broken; log: log"),
        ("import os, signal; os.kill(os.getpid(), signal.SIGKILL)", 1, "killed by SIGKILL; log: log"),
        ("raise SystemExit(143)", 143, "stopped by SIGTERM; continue with: python -m program resume=run"),
    ],
)
def test_the_outcome_of_a_run_is_reported(program, text, exit_code, reason):
    outcome = program(text, run_dir="run")()
    assert (outcome.exit_code, outcome.reason) == (exit_code, reason)


def test_a_run_gets_its_environment(program, monkeypatch):
    monkeypatch.setenv("A", "1")
    text = "import os; raise SystemExit(0 if (os.environ.get('A'), os.environ['B']) == (None, '2') else 1)"
    assert program(text, environment={"A": None, "B": "2"})().exit_code == 0


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGHUP])
def test_signals_are_passed_on(program, tmp_path, number):
    after_begin(tmp_path, lambda: os.kill(os.getpid(), number))
    assert program(WAITS)().exit_code == 143
    assert signal.getsignal(number) == signal.SIG_DFL


def test_a_time_limit_stops_a_run_that_can_be_resumed(program, tmp_path):
    """As in submitit, whose handler asks for the job to queue again, then ends the process."""
    run = program(WAITS, run_dir="run")
    (tmp_path / "run").mkdir()
    queued = []

    def warn(*_):
        queued.append(run.checkpoint().function)
        (tmp_path / "run" / "config.yaml").touch()
        queued.append(run.checkpoint().function)
        raise SystemExit(-1)

    previous = signal.signal(signal.SIGUSR2, warn)
    try:
        after_begin(tmp_path, lambda: os.kill(os.getpid(), signal.SIGUSR2))
        with pytest.raises(SystemExit):
            run()
    finally:
        signal.signal(signal.SIGUSR2, previous)
    assert [command.arguments for command in queued] == [[], ["resume=run"]]  # before it had begun to write, and after
    assert queued[1].run_dir == "run" and queued[1].log == "log"


def test_each_slot_has_gpus_of_its_own():
    assert [gpus_of(slot, 2, None) for slot in (0, 1)] == ["0,1", "2,3"]
    assert gpus_of(1, 1, "4,GPU-a") == "GPU-a"
    assert gpus_of(3, None, "4") == "4" and gpus_of(3, None, None) is None
    with pytest.raises(HydraException, match="3 runs with 1 GPUs each need 3, got 2"):
        gpus_of(2, 1, "0,1")


@pytest.fixture
def sweep(tmp_path, monkeypatch):
    """A function that sweeps a command over folders and returns the exit code; `work` takes a folder's name."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(cli, "schema", schemas)

    def run(work, *folders):
        arguments = ["-m", f"folder={','.join(folders)}", "hydra.sweep.dir=sweep"]
        monkeypatch.setattr(sys, "argv", ["mimic.collect", *arguments])
        with pytest.raises(SystemExit) as stop:
            cli.run(lambda config: lambda: work(config.folder), "collect")
        return stop.value.code

    return run


def test_in_one_process_an_error_ends_its_run_alone(sweep, tmp_path, capsys):
    assert sweep(lambda folder: {"fine": None, "three": 3}[folder], "unknown", "fine", "three") == 1
    runs = json.loads((tmp_path / "sweep" / "sweep.json").read_text())["runs"]
    assert [(run["exit_code"], run["reason"]) for run in runs] == [
        (1, "KeyError: 'unknown'"),
        (0, ""),
        (3, "exit code 3"),
    ]
    assert "Traceback" in capsys.readouterr().err


def test_in_one_process_a_signal_ends_the_sweep(sweep):
    begun = []
    assert sweep(lambda folder: begun.append(folder) or {"stopped": 143}.get(folder), "fine", "stopped", "more") == 143
    assert begun == ["fine", "stopped"]


SHORT = [*TINY, "trainer.num_timesteps=2000", "trainer.evaluations=1"]


@pytest.mark.slow
@pytest.mark.timeout(900)
def test_a_sweep_is_collected(tmp_path):
    choice = ["hydra/launcher=submitit_local", "hydra.launcher.parallel=2", "hydra.sweep.dir=runs/mine"]
    swept = ["env=planar4dof,planar7dof", "seed=0,1"]
    result = command("train", "-m", *SHORT[1:], *swept, *choice, cwd=tmp_path)
    assert result.returncode == 0, result.stderr[-2000:]
    assert "python -m mimic.collect folder=runs/mine" in result.stdout
    result = command("collect", "runs/mine", cwd=tmp_path)
    assert result.returncode == 0, result.stderr[-2000:]
    collected = json.loads((tmp_path / "runs" / "mine" / "collected.json").read_text())
    assert [(group["label"], group["seeds"]) for group in collected["groups"]] == [
        ("planar4dof", [0, 1]),
        ("planar7dof", [0, 1]),
    ]
    assert collected["groups"][0]["runs"][1] == "1-planar4dof-ppo-seed1"
    imports = [group["numbers"]["wall_time_s.import"]["max"] for group in collected["groups"]]
    assert max(imports) < 60  # from the start of each run, not of the sweep
    gap = collected["groups"][1]["numbers"]["optimality_gap.held_out"]
    assert gap["low"] < gap["min"] < gap["mean"] < gap["max"] < gap["high"]
    for name in ("collected.csv", "collected.png"):
        assert (tmp_path / "runs" / "mine" / name).stat().st_size > 0


@pytest.mark.slow
@pytest.mark.parametrize("launcher", ["basic", "submitit_local"])
def test_ctrl_c_ends_a_sweep_at_the_next_checkpoint(launcher, tmp_path):
    arguments = ["-m", *SHORT, *ENDLESS, "seed=0,1", f"hydra/launcher={launcher}", "hydra.sweep.dir=sweep"]
    process = start("train", *arguments, cwd=tmp_path, start_new_session=True)
    wait_for(tmp_path, "sweep/0-*/checkpoints/0*[1-9]*", process)
    os.killpg(process.pid, signal.SIGINT)  # as a terminal does
    _, error = process.communicate(timeout=120)
    assert process.returncode == 130, error[-2000:]
    assert "the sweep was stopped" in error
    assert not list(tmp_path.glob("sweep/1-*"))
    result = command("collect", "sweep", cwd=tmp_path)
    assert result.returncode == 2 and "expected runs with a report.json, found none" in result.stderr


def running(text):
    """Ids of the processes with this in their command."""
    numbers = []
    for path in pathlib.Path("/proc").glob("[0-9]*"):
        with contextlib.suppress(OSError):
            if text in (path / "cmdline").read_bytes().decode(errors="replace"):
                numbers.append(int(path.name))
    return numbers


@pytest.mark.slow
def test_ctrl_c_twice_ends_a_sweep_and_its_runs_immediately(tmp_path):
    endless = ["trainer.num_timesteps=100000000", "trainer.evaluations=1"]  # no checkpoint for a long time
    arguments = ["-m", *SHORT, *endless, "seed=0,1", "hydra/launcher=submitit_local", "hydra.launcher.parallel=2"]
    process = start("train", *arguments, f"hydra.sweep.dir={tmp_path}/sweep", cwd=tmp_path, start_new_session=True)
    wait_for(tmp_path, "sweep/*/config.yaml", process, count=2)
    for pause in (1.0, 0.0):
        os.killpg(process.pid, signal.SIGINT)
        time.sleep(pause)
    _, error = process.communicate(timeout=30)
    assert process.returncode == 130 and "Traceback" not in error, error[-2000:]
    assert "the sweep was stopped" in error
    until = time.monotonic() + 20
    while left := running(str(tmp_path)):
        assert time.monotonic() < until, left
        time.sleep(0.2)
