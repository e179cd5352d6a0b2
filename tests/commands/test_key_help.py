"""`--help` shows a value and an explanation for every key, and the values of presets."""

import dataclasses
import importlib
import re
import sys
import typing

import pytest
from omegaconf import DictConfig

from mimic.__main__ import commands
from mimic.commands import cli
from mimic.commands.key_help import explanations, key_lines
from mimic.trainers.config import BUILT_IN_TRAINERS
from mimic.trainers.presets import MAPPER_PRESETS, PPO_PRESETS


def shown(monkeypatch, capsys, *arguments):
    """The keys of the help of a training."""
    monkeypatch.setattr(sys, "argv", ["mimic.train", *arguments, "--help"])
    cli.run(lambda config: pytest.fail("the command ran"), "train")
    text, keys = capsys.readouterr().out.split("All keys, with their current values:\n\n")
    assert "usage: " in text and "panda4dof" in text and "resume=DIR" in text
    return keys


@pytest.mark.parametrize("name", commands())
def test_every_key_has_an_explanation(name, schemas):
    config_class = typing.get_type_hints(importlib.import_module(f"mimic.{name}").prepare)["config"]
    for line in key_lines(DictConfig(schemas(config_class))):
        assert line.endswith(":") or re.search(r": .*  # \w|: +# \w|  # \S", line), line
        assert not re.search(r"[,;:(] ?see [\w.]", line) and not re.search(r"# .*see \w+Config", line), line


@pytest.mark.parametrize("config_class", BUILT_IN_TRAINERS.values())
def test_every_key_of_a_trainer_is_documented(config_class):
    assert {field.name for field in dataclasses.fields(config_class)} == set(explanations(config_class))


def value(keys, key):
    match = re.search(rf"^ *{key}: (.*?)  +#", keys, re.MULTILINE)
    assert match, key
    return match[1]


def test_presets_are_shown_in_place_of_null(monkeypatch, capsys):
    keys = shown(monkeypatch, capsys)
    cpu, gpu = (PPO_PRESETS[name]["num_envs"] for name in ("cpu", "gpu"))
    assert value(keys, "num_envs") == f"{cpu} (cpu, any_arm_cpu, inner_loop_cpu), {gpu} (gpu, any_arm, inner_loop)"
    assert value(keys, "unroll_length") == "10"
    keys = shown(monkeypatch, capsys, "trainer.preset=gpu", "trainer.crossovers=7")
    assert value(keys, "num_envs") == str(PPO_PRESETS["gpu"]["num_envs"]) and value(keys, "crossovers") == "7"
    keys = shown(monkeypatch, capsys, "trainer=pose_mapper", "trainer.preset=paper")
    assert value(keys, "samples") == str(MAPPER_PRESETS["paper"]["samples"])
    keys = shown(monkeypatch, capsys, "env=panda3dof")
    assert "[2, 3, 6, 7]" in keys
