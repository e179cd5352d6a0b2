"""Completion of commands, groups and keys, and the scripts for the shells."""

import os
import shutil
import subprocess
import sys

import pytest

from mimic.shell_completion import SCRIPTS, candidates
from tests.helpers.repository import REPOSITORY

COMMANDS = ("inspect", "render", "retarget", "train", "completion")


@pytest.mark.parametrize(
    ("line", "expected"),
    [
        ("mimic", []),
        ("mimic re", ["render ", "retarget "]),
        ("mimic completion z", ["zsh "]),
        ("mimic train env=panda", ["env=panda3dof ", "env=panda4dof ", "env=panda7dof "]),
        ("mimic train env", ["env.", "env="]),
        ("mimic train env.limi", ["env.limit_weight=", "env.limits="]),
        ("mimic train env.learner.lo", ["env.learner.locked="]),  # a list, whose entries are no keys
        ("mimic train env.learner=arm.xml trainer=pose_mapper trainer.sam", ["trainer.samples="]),
        ("mimic train trainer=ppo trainer.sam", []),
        ("mimic inspect arm.xml lim", ["limits="]),
        ("mimic train env.learner=[ tra", []),
        ("mimic nothing x", []),
        ("mimic train --hel", []),
    ],
)
def test_candidates(line, expected):
    assert candidates(line, COMMANDS) == expected


def test_keys_are_completed_without_schemas_and_keys_of_hydra():
    keys = candidates("mimic train ", COMMANDS)
    assert {"env=", "seed=", "trainer."} <= set(keys) and not [key for key in keys if key.startswith("hydra")]
    assert candidates("mimic train hydra/la", COMMANDS) == ["hydra/launcher="]
    assert "env=schema " not in candidates("mimic train env=", COMMANDS)


def completed_by_bash(line, folder):
    """What bash proposes, by the script and a command `mimic` on the path."""
    command = folder / "mimic"
    command.write_text(f'#!/bin/sh\nexec "{sys.executable}" -m mimic "$@"\n')
    command.chmod(0o755)
    script = f'{SCRIPTS["bash"]}\nCOMP_LINE="$1" COMP_POINT=${{#1}} _mimic\nprintf "<%s>" "${{COMPREPLY[@]}}"'
    environment = {**os.environ, "PATH": f"{folder}:{os.environ['PATH']}", "PYTHONPATH": str(REPOSITORY)}
    shell = ["bash", "-c", script, "bash", line]
    return subprocess.run(shell, env=environment, capture_output=True, text=True, check=True).stdout


@pytest.mark.skipif(not shutil.which("bash"), reason="needs bash")
def test_bash_completes_the_part_after_an_equals_sign(tmp_path):
    assert completed_by_bash("mimic train env=planar", tmp_path) == "<planar4dof ><planar7dof >"


@pytest.mark.parametrize("shell", SCRIPTS)
def test_the_scripts_are_valid_and_ask_for_candidates(shell):
    assert "mimic completion query" in SCRIPTS[shell]
    if not shutil.which(shell):
        pytest.skip(f"needs {shell}")
    subprocess.run([shell, "-n"], input=SCRIPTS[shell], text=True, check=True)
