"""Odd command lines: one line and exit code 2, without a traceback, a usage text or a training that nobody meant."""

import errno
import os
import re
import sys

import pytest

from mimic.commands import cli
from mimic.commands.arguments import check_arguments

# What is invalid in every command.
EARLY = [
    (["env=null"], "env: expected the name of a preset, as in env=panda4dof, got None"),
    (["env=[]"], "env: expected the name of a preset"),
    (["env={}"], "env: expected a value, got {}"),
    (["env=schema"], "env: expected the name of a preset"),
    (["~env"], "~env: keys cannot be removed"),
    (["~trainer=ppo"], "keys cannot be removed"),
    (["trainer=null"], "trainer: expected the name of a preset, as in trainer=ppo, got None"),
    (["env.learner={}"], "env.learner: expected a value, got {}"),
    (["=1"], "expected KEY=VALUE, got '=1'"),
    (["env", "panda4dof"], "expected KEY=VALUE, got 'env'"),
    (["--bogus"], "unrecognized arguments: --bogus"),
    (["--cfg=bogus"], "invalid choice: 'bogus'"),
    (["--experimental-rerun=x"], "loads a pickle"),
    (["env=${oc.env:SECRET_TOKEN}"], "env: expected the name of a preset"),
]
# What Hydra, the sweeper or the config reject.
LATE = [
    (["env.learner=null"], "env.learner.model"),
    (["env.metric=paper"], "env.metric: expected keys of its own, as in env.metric.KEY=VALUE, got 'paper'"),
    (["trainer.hidden_layers=[[1]]"], "trainer.hidden_layers: expected 1 to 32 whole numbers"),
    (["env.learner.locked=[[1]]"], "locked: unknown joint [1]"),
    (["--shell-completion"], "subcommand"),
    (["seed=" + "[" * 3000], "error"),
    (["-m", "seed=range(1000000000)"], "expected at most 1,000 runs in a sweep"),
    (["-m", "seed=glob(*)"], "expected at least 1 run"),
    (["-m", "seed=1,2", "hydra.sweep.dir=/dev/null/x"], "hydra.sweep.dir: '/dev/null/x': cannot write in '/dev/null'"),
    (["run_dir=${oc.env:SECRET_TOKEN}"], "run_dir: expected no ${...} other than a reference to a key"),
    (["-m", "run_dir='${oc.env:SECRET_TOKEN}',b"], "run_dir: expected no ${...} other than a reference to a key"),
]


@pytest.mark.parametrize(("arguments", "message"), EARLY, ids=[" ".join(arguments) for arguments, _ in EARLY])
def test_arguments_that_every_command_rejects(arguments, message):
    with pytest.raises(ValueError, match=re.escape(message)) as error:
        check_arguments(arguments)
    assert str(error.value).splitlines() == [str(error.value)]


@pytest.mark.slow_for(*(" ".join(arguments)[:50] for arguments, _ in LATE[4:-2]))
@pytest.mark.parametrize(
    ("arguments", "message"), [EARLY[0], *LATE], ids=[" ".join(arguments)[:50] for arguments, _ in [EARLY[0], *LATE]]
)
@pytest.mark.usefixtures("unchecked")
def test_odd_command_lines(rejected, monkeypatch, arguments, message):
    monkeypatch.setenv("SECRET_TOKEN", "not-for-others")
    error = rejected("train", *arguments)
    assert message in error and "not-for-others" not in error and len(error) < 1100


@pytest.mark.parametrize(
    ("argument", "expected"),
    [
        ("out=run (1)", "out='run (1)'"),
        ("source=motions [old].csv", "source='motions [old].csv'"),
        ("source=a,b.csv", "source='a,b.csv'"),  # a file, and not two values of a sweep
        ("source='a,b.csv'", "source='a,b.csv'"),
        ("source=it's.csv", r"source='it\'s.csv'"),
        ("seed=1,2", "seed=1,2"),
        ("env.learner.locked=[3,4", "env.learner.locked=[3,4"),  # an error of Hydra
        ("env.learner.home={a:1}", "env.learner.home={a:1}"),
        ("--multirun", "--multirun"),
    ],
)
def test_files_with_any_name_are_text(tmp_path, monkeypatch, argument, expected):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "a,b.csv").touch()
    assert cli.expand_arguments([argument], "train") == [expected]
    (tmp_path / "a = (1).urdf").touch()
    assert "learner.model='a = (1).urdf'" in cli.expand_arguments(["a = (1).urdf"], "inspect")


def test_absurd_recordings(reason):
    steps = ["env.demonstrations.count=100000", "env.horizon=10000"]
    assert "physics steps to record, got 10,008,000,000" in reason("train", "env=panda4dof", *steps)


@pytest.mark.parametrize("run_dir", ["/dev/null/x", "a/" * 3000])
def test_run_directories_that_cannot_be_written(reason, run_dir):
    error = reason("train", "env=planar4dof", f"run_dir={run_dir}")
    assert "run_dir: " in error and ("cannot write in" in error or "expected a shorter path" in error)


def test_a_dangling_link_as_a_run_directory(reason, tmp_path):
    os.symlink(tmp_path / "missing", tmp_path / "run")
    assert "exists; name a new folder" in reason("train", "env=planar4dof", f"run_dir={tmp_path}/run")


def test_a_full_disk_during_the_work_is_one_line(monkeypatch, capsys, tmp_path):
    def work():
        raise OSError(errno.ENOSPC, "No space left on device", "metrics.csv")

    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", ["mimic.collect"])
    with pytest.raises(SystemExit) as stop:
        cli.run(lambda config: work, "collect")
    error = capsys.readouterr().err
    assert stop.value.code == 1 and error == "error: [Errno 28] No space left on device: 'metrics.csv'\n"


def test_bugs_in_the_work_keep_their_traceback(monkeypatch, tmp_path):
    def work():
        raise ValueError("a bug")

    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", ["mimic.collect"])
    with pytest.raises(ValueError, match="a bug"):
        cli.run(lambda config: work, "collect")


def test_a_hostile_file_in_a_folder_of_configs(rejected, tmp_path):
    (tmp_path / "configs" / "env").mkdir(parents=True)
    aliases = "".join(f"{new}: &{new} [*{old},*{old},*{old}]\n" for old, new in zip("abcdef", "bcdefg", strict=True))
    (tmp_path / "configs" / "env" / "mine.yaml").write_text("a: &a [1,1]\n" + aliases)
    assert "expected no aliases, got *a" in rejected("train", f"--config-dir={tmp_path}/configs", "env=mine")


@pytest.mark.parametrize(
    "arguments",
    [
        ["env=pair", "metric=null", "seed=1", "run_dir=runs/${seed}", "env.learner.locked=[3,6]"],
        ["-m", "metric=paper", "env={horizon: 30}", "hydra.sweep.dir=runs/${now:%Y}", "seed=1,2", "env=pair,panda4dof"],
        ["--config-dir=/tmp", "--cfg=job"],
        ["resume=run", "logger=wandb", "env.learner.locked={joint3: 0.5}"],
    ],
)
def test_usual_command_lines_pass(arguments):
    check_arguments(arguments)
