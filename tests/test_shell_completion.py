"""Completion of commands, groups and keys, and the scripts for the shells."""

import os
import shutil
import subprocess
import sys

import pytest

from mimic.shell_completion import SCRIPTS, candidates
from tests.helpers.shells import fish_candidates, lines_after_tab

COMMANDS = ("inspect", "render", "retarget", "train", "completion")


@pytest.mark.parametrize(
    ("line", "expected"),
    [
        ("mimic", []),
        ("mimic re", ["render ", "retarget "]),
        ("mimic completion z", ["zsh "]),
        ("mimic train env=panda", ["env=panda3dof ", "env=panda4dof ", "env=panda7dof ", "env=panda_family "]),
        ("mimic train env", ["env.", "env="]),
        ("mimic train env.limi", ["env.limit_weight=", "env.limits="]),
        ("mimic train env.learner.lo", ["env.learner.locked="]),  # a list, whose entries are no keys
        ("mimic train env.learner=arm.xml trainer=pose_mapper trainer.sam", ["trainer.samples="]),
        ("mimic train trainer=ppo trainer.sam", []),
        ("mimic inspect arm.xml lim", ["limits="]),
        ("mimic train env.learner=[ tra", []),
        ("mimic nothing x", []),
        ("mimic train --hel", []),
        ("mimic inspect ./", []),  # files are the shell's
        ("mimic train env.learner=./", []),
    ],
)
def test_candidates(line, expected):
    assert candidates(line, COMMANDS) == expected


def test_keys_are_completed_without_schemas_and_keys_of_hydra():
    keys = candidates("mimic train ", COMMANDS)
    assert {"env=", "seed=", "trainer."} <= set(keys) and not [key for key in keys if key.startswith("hydra")]
    assert candidates("mimic train hydra/la", COMMANDS) == ["hydra/launcher="]
    assert "env=schema " not in candidates("mimic train env=", COMMANDS)


AFTER_TAB = {
    "mimic rend": "mimic render ",
    "mimic train env=planar4": "mimic train env=planar4dof ",
    "mimic train env=plan": "mimic train env=planar",  # two candidates
    "mimic train env.learner.lo": "mimic train env.learner.locked=",  # a value follows: no space
    "mimic inspect ar": "mimic inspect arm.xml ",
    "mimic train env.learner=ar": "mimic train env.learner=arm.xml ",
    "mimic train env.learner=./ar": "mimic train env.learner=./arm.xml ",
}


@pytest.fixture(scope="module")
def variables(tmp_path_factory):
    """Environment variables of a shell whose command `mimic` answers with the real scripts and candidates."""
    cases = {f"{shell}:": text for shell, text in SCRIPTS.items()}
    cases |= {f"query:{line}": "".join(f"{word}\n" for word in candidates(line, COMMANDS)) for line in (*AFTER_TAB, "")}
    answers = "".join(f"'{case}') cat <<'END'\n{text}END\n;;\n" for case, text in cases.items())
    command = tmp_path_factory.mktemp("bin") / "mimic"
    command.write_text(f'#!/bin/sh\ncase "$2:$3" in\n{answers}*) echo "unexpected-$3" ;;\nesac\n')
    command.chmod(0o755)
    return {**os.environ, "PATH": f"{command.parent}:{os.environ['PATH']}"}


@pytest.mark.parametrize("shell", ["bash", "zsh"])
def test_the_tab_key_completes(shell, variables, tmp_path):
    if not shutil.which(shell):
        pytest.skip(f"needs {shell}")
    (tmp_path / "arm.xml").touch()
    assert lines_after_tab(shell, AFTER_TAB, tmp_path, variables) == list(AFTER_TAB.values())


@pytest.mark.skipif(not shutil.which("fish"), reason="needs fish")
def test_fish_proposes_candidates_and_files(variables, tmp_path):
    (tmp_path / "arm.xml").touch()
    for line, after in AFTER_TAB.items():
        proposed = fish_candidates(line, tmp_path, variables)
        words = [line.rpartition(" ")[0] + " " + word for word in proposed]
        assert words == ([after.strip()] if after != "mimic train env=planar" else [f"{after}{n}dof" for n in (4, 7)])


def test_a_command_answers_a_shell():
    """Without a double of the command: what bash asks for, from the process that it starts."""
    command = [sys.executable, "-m", "mimic", "completion", "query", "mimic train env=planar4"]
    assert subprocess.run(command, capture_output=True, text=True, check=True).stdout == "env=planar4dof \n"


@pytest.mark.parametrize("shell", SCRIPTS)
def test_the_scripts_are_valid_and_ask_for_candidates(shell):
    assert "mimic completion query" in SCRIPTS[shell]
    if not shutil.which(shell):
        pytest.skip(f"needs {shell}")
    subprocess.run([shell, "-n"], input=SCRIPTS[shell], text=True, check=True)
