"""Odd command lines: numbers out of range, config groups, syntax, options, references, paths.

A command line is read in this process up to its checked config. A training of few and short demonstrations is also
prepared: its arms are built and its demonstrations recorded.
"""

import contextlib
import dataclasses
import functools
import importlib
import io
import math
import os
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.random import Generator

from benchmarks.fuzzing import ACCEPTED, OTHER_NUMBERS, Case
from mimic.base.config import flatten, to_dict
from mimic.base.ranges import Range, all_ranges
from mimic.commands import cli
from mimic.commands import config as commands
from mimic.trainers.config import PoseMapperConfig, PPOConfig, TrainConfig
from mimic.trainers.export.config import ExportConfig

SEED = 2025
SECRET_NAME, SECRET = "SECRET_TOKEN", "fuzz-5e1f-secret"
_SMALL = ["env=planar4dof", "env.demonstrations.count=2", "env.demonstrations.held_out=1", "env.horizon=5"]
_MAX_PREPARED_STEPS = 20_000  # physics steps: about a second
_COMMANDS = {
    "evaluate": commands.EvaluateConfig,
    "render": commands.RenderConfig,
    "export": ExportConfig,
    "dataset": commands.DatasetConfig,
    "demonstrations": commands.RecordingConfig,
    "inspect": commands.InspectConfig,
    "retarget": commands.RetargetConfig,
    "view": commands.ViewConfig,
    "collect": commands.CollectConfig,
}
_EXTREMES = (
    "nan", "inf", "-inf", "1e30", "-1e30", "1e38", "3.5e38", "1e-30", "1e-320", "1e400", "-1", "0", "-0.0",
    "1000000000", "2147483648", "-2147483649", "4294967296", "9223372036854775808", "18446744073709551616",
    "-9223372036854775809", "1_000", "0x10", "1e3", ".5", "5.", "true", "null", "[]", "[1]", "[[1]]", "{}", "{a:1}",
    "''", "abc", "1,2", "[1,2]", "[nan]", "[1e30,1e30]", "[1000000,1000000]", "[0,0]", "[-1]", "???", "1.0000000001",
    "0.1e-400", "---1", "+5", "\\\\", "é", "' '",
)  # fmt: skip
_GROUPS = (
    "env", "trainer", "metric", "env.expert", "env.learner", "env.metric", "env.demonstrations", "env.randomization",
    "distributed",
)  # fmt: skip
_VALUES = (
    "null", "{}", "[]", "[[]]", "''", "1", "nan", "true", "???", "schema", "env_schema", "ppo_schema", "../env/pair",
    "/pair", "[pair,ppo]", "${seed}", "{a:1}",
)  # fmt: skip
_OPTIONS = (
    "--bogus", "-x", "--cfg", "--cfg=bogus", "--cfg=job", "--package=env", "--config-name=nope", "--config-path=/nope",
    "--config-dir=/nope", "--config-dir", "--info=x", "--info=config", "--resolve", "--shell-completion", "-sc",
    "--experimental-rerun=x", "--experimental-rerun", "--hydra-help", "--help", "--version", "-m", "--multirun",
    "--run", "-mr", "--", "--=", "-",
)  # fmt: skip
_REFERENCES = (
    "${oc.env:SECRET_TOKEN}", "${oc.env:SECRET_TOKEN,x}", "${oc.env:NOPE,${oc.env:SECRET_TOKEN}}", "${oc.decode:1}",
    "${seed}", "${env}", "${oc.create:[1]}", "${hydra:runtime.cwd}", "${now:%Y}", "${}", "${", "${${seed}}", "${.}",
    "${..}", "${..seed}", "${nope}", "${env.nope}", "$seed", "${env.learner.locked}", "${oc.dict.keys:env}",
    "\\${oc.env:SECRET_TOKEN}", "\\\\${oc.env:SECRET_TOKEN}", "${run_dir}", "${trainer}",
)  # fmt: skip
_PATHS = (
    "/proc/x", "/dev/null/x", "/sys/x", "/dev/full", "/etc/passwd/x", "/proc/self/mem", ".", "..", "/", "~",
    "~nobody/x", "a//b", "''", "./../../x", "a\\nb", "é", "\x7f", "'a b'", "' '",
)  # fmt: skip


def command_line_case(number: int) -> Case:
    """Command line `number`: its arguments, and reading them."""
    rng = np.random.default_rng([SEED, number])
    kinds: tuple[Callable[[Generator], tuple[str, list[str]]], ...] = (
        _number, _number, _number, _group, _syntax, _option, _reference, _path, _other_command,
    )  # fmt: skip
    kind = kinds[number % len(kinds)]
    command, arguments = kind(rng)
    return Case(
        kind.__name__.removeprefix("_"),
        lambda folder: None,
        functools.partial(_read, command=command, arguments=arguments),
    )


@functools.cache
def _ranges(trainer: str) -> Sequence[tuple[str, Range]]:
    config = {"ppo": PPOConfig, "pose_mapper": PoseMapperConfig}[trainer]
    return [*all_ranges(TrainConfig), *((f"trainer.{key}", limits) for key, limits in all_ranges(config))]


def _pick(rng: Generator, values: Sequence[Any]) -> Any:
    return values[int(rng.integers(len(values)))]


def _near(rng: Generator, limits: Range) -> str:
    """A number at, within or just outside a limit."""
    limit = _pick(rng, (limits.minimum, limits.maximum))
    if isinstance(limit, int):
        value: float = limit + int(rng.integers(-1, 2))
    else:
        value = _pick(rng, (limit, float(np.nextafter(limit, -np.inf)), float(np.nextafter(limit, np.inf)), -limit))
    return str(value) if limits.entries is None else f"[{value},{value}]"


def _number(rng: Generator) -> tuple[str, list[str]]:
    trainer = _pick(rng, ("ppo", "pose_mapper"))
    arguments = [*_SMALL, f"trainer={trainer}"]
    for _ in range(rng.integers(1, 3)):
        key, limits = _pick(rng, _ranges(trainer))
        arguments.append(f"{key}={_near(rng, limits) if rng.random() < 0.4 else _pick(rng, _EXTREMES)}")
    return "train", arguments


def _group(rng: Generator) -> tuple[str, list[str]]:
    key, value = _pick(rng, _GROUPS), _pick(rng, _VALUES)
    form = _pick(rng, ("{0}={1}", "{0}={1}", "~{0}", "+{0}={1}", "++{0}={1}", "{0}@x={1}", "{0}/x={1}", "~{0}={1}"))
    sweep = ["-m"] if rng.random() < 0.1 else []
    return "train", [*sweep, *_SMALL[1:], form.format(key, value)]


def _syntax(rng: Generator) -> tuple[str, list[str]]:
    text = _pick(rng, (*_SMALL, "seed=1", "trainer.hidden_layers=[8,8]", "env.learner.locked={joint1:0.1}", "=", ""))
    for _ in range(rng.integers(1, 6)):
        place, kind = int(rng.integers(len(text) + 1)), int(rng.integers(4))
        symbol = _pick(rng, "=,[]{}()'\"$:~+@/\\ \t\n.*?#;|&<>%!-01aé\u202e\U0001f600")
        text = {
            0: text[:place] + symbol + text[place:],
            1: text[:place] + text[place + 1 :],
            2: text[:place] + text[place:] * 2,
            3: text[:place] + symbol * int(rng.integers(1, 2000)) + text[place:],
        }[kind]
    return "train", [*_SMALL, text]


def _option(rng: Generator) -> tuple[str, list[str]]:
    options = [_pick(rng, _OPTIONS) for _ in range(rng.integers(1, 3))]
    return "train", [*options, *_SMALL]


def _reference(rng: Generator) -> tuple[str, list[str]]:
    key = _pick(
        rng, ("run_dir", "seed", "env.name", "logger", "env.learner.locked", "trainer.num_envs", "env", "resume")
    )
    value = "".join(_pick(rng, _REFERENCES) for _ in range(_pick(rng, (1, 1, 1, 2, 40))))
    return "train", [*_SMALL, f"{key}={value}" if rng.random() < 0.5 else f"{key}='{value}'"]


def _path(rng: Generator) -> tuple[str, list[str]]:
    key = _pick(rng, ("run_dir", "resume", "env.demonstrations.path", "env.learner.model", "env.expert", "run_dir"))
    path = _pick(rng, (*_PATHS, "x" * 300, "a/" * 3000))
    return "train", [*_SMALL, f"{key}={path}"]


def _other_command(rng: Generator) -> tuple[str, list[str]]:
    command = _pick(rng, tuple(_COMMANDS))
    fields = [field.name for field in dataclasses.fields(_COMMANDS[command]) if field.name != "env"]
    value = _pick(rng, (*_EXTREMES, *_PATHS, *_REFERENCES))
    return command, [f"{_pick(rng, fields)}={value}"]


def _read(folder: Path, *, command: str, arguments: list[str]) -> str:
    """Runs the command up to its prepared work.

    Raises:
      ValueError: its one line, if it is rejected as bad input.
      RuntimeError: any other end.
    """
    outputs, configs = (io.StringIO(), io.StringIO()), list[Any]()

    def prepare(config: Any) -> cli.Work:
        configs.append(config)
        if command == "train":
            _prepare_training(config)
        return lambda: 0

    code: Any = 0
    previous, sys.argv = sys.argv, [f"mimic.{command}", *arguments]
    os.environ[SECRET_NAME] = SECRET
    try:
        with contextlib.redirect_stdout(outputs[0]), contextlib.redirect_stderr(outputs[1]):
            cli.run(prepare, command)
    except SystemExit as stop:
        code = stop.code or 0
    finally:
        sys.argv = previous
        del os.environ[SECRET_NAME]
    out, error = (output.getvalue() for output in outputs)
    shown = " ".join([out, error, *map(str, configs)])
    if SECRET in shown or any(not math.isfinite(x) for config in configs for x in _numbers(config)):
        return OTHER_NUMBERS
    if code == 0 or (code == 1 and "sweep:" in out):  # the runs of a sweep fail one by one
        return ACCEPTED
    if code == cli.BAD_INPUT and error.startswith("error: ") and error.count("\n") == 1:
        raise ValueError(error.strip())
    raise RuntimeError(f"{arguments}: exit code {code}: {error}")


def _numbers(config: Any) -> list[float]:
    return [value for value in flatten(to_dict(config)).values() if isinstance(value, int | float)]


def _prepare_training(config: TrainConfig) -> None:
    """What `prepare_training` checks; for few physics steps also what it makes."""
    from mimic.runs.loggers import check_loggers
    from mimic.trainers.memory import check_training_memory
    from mimic.trainers.run_config import new_run_dir
    from mimic.trainers.run_training import prepare_training

    demonstrations = config.env.demonstrations
    steps = (demonstrations.count + demonstrations.held_out) * config.env.horizon * config.env.substeps
    trainer: Any = config.trainer
    crossovers = getattr(trainer, "crossovers", 0) or 0
    if steps <= _MAX_PREPARED_STEPS and crossovers <= 1000 and len(config.env.learner.link_lengths) < 20:
        local = dataclasses.replace(
            config, logger="local", distributed=type(config.distributed)(), compilation_cache=""
        )
        prepare_training(local, 0.0, [])
        return
    check_loggers([])
    new_run_dir(config)
    check_training_memory(config)


def import_commands() -> None:
    """Imports what the first command would import."""
    importlib.import_module("mimic.trainers.run_training")
