"""Damaged and hostile run directories: config, report, metrics, plan of a sweep, checkpoints."""

import functools
import math
import os
import shutil
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import numpy as np
from numpy.random import Generator

import mimic
from benchmarks.fuzzing import ACCEPTED, OTHER_NUMBERS, Case
from benchmarks.fuzzing.configs import SECRET, SECRET_NAME
from mimic.base.config import flatten, to_dict
from mimic.commands.collect.collect import prepare_collection
from mimic.commands.config import CollectConfig
from mimic.runs.checkpoints import FOLDER, load_checkpoint, save_checkpoint
from mimic.runs.files import CONFIG, METRICS, REPORT, write_report
from mimic.runs.sweeps.sweeper import SWEEP
from mimic.trainers.config import PoseMapperConfig, TrainConfig
from mimic.trainers.pose_mapper.trainer import PoseMapperTrainer
from mimic.trainers.run_config import load_config, save_config

SEED = 2026
RUN = "run"
_TRAINER = PoseMapperConfig(
    hidden_layers=[8], samples=64, batch_size=32, epochs=1, validation_poses=8, held_out_poses=8
)
_HOSTILE = (
    b"nan", b".nan", b".inf", b"1e400", b"-1", b"999999999999999999999", b"null", b"{}", b"[]", b"[[[[[[[[]]]]]]]]",
    b"${oc.env:SECRET_TOKEN}", b"${seed}", b"${env}", b"${..}", b"&a [*a]", b"*a", b"!!python/object:os.system ls",
    b"'", b'"', b"\x00", b"\xff\xfe", b"true", b"'' ", b"9" * 5000, b"[" * 3000, b"{a: " * 3000, b"x" * 200_000,
    b"NaN", b"Infinity", b"1e309", b"- - - -", b"? ? ? ?", b"|", b">-", b"%YAML 9", b"---", b"...", b"<<: *a", b",,,,",
)  # fmt: skip
_BOMB = b"a: &a [1,1,1,1,1,1,1,1,1]\n" + b"".join(
    b"%c: &%c [%s]\n" % (x + 1, x + 1, b",".join([b"*%c" % x] * 9)) for x in range(ord("a"), ord("j"))
)
_REFERENCES = b"trainer: {name: ppo}\nrun_dir: " + b"x" * 1000 + b"\n" + b"resume: " + b"${run_dir}" * 500 + b"\n"
Damage = Callable[[bytes, Generator], bytes]


def run_case(number: int) -> Case:
    """Damaged run directory `number`."""
    rng = np.random.default_rng([SEED, number])
    name = ("config", "report", "metrics", "sweep", "checkpoint", "checkpoint")[number % 6]
    if name == "checkpoint":
        return Case(name, functools.partial(_write_checkpoint, rng=rng), _read_checkpoint)
    damage = _DAMAGES[int(rng.integers(len(_DAMAGES)))]
    file = {"config": CONFIG, "report": REPORT, "metrics": METRICS, "sweep": SWEEP}[name]
    write = functools.partial(_write_text, file=file, damage=damage, rng=rng)
    return Case(f"{name}: {damage.__name__.removeprefix('_')}", write, _read_run)


@functools.cache
def _good_run() -> Path:
    """A run directory with initial parameters, in a folder that ends with the process."""
    root = Path(tempfile.mkdtemp(prefix="mimic-fuzz-"))
    config = TrainConfig(mimic.env_config("planar4dof"), _TRAINER, compilation_cache="").resolve()
    trainer = PoseMapperTrainer(config)
    run_dir = root / RUN
    run_dir.mkdir()
    save_config(run_dir, TrainConfig(config.env, trainer.settings, compilation_cache=""))
    params = trainer._model.init(jax.random.key(0))
    save_checkpoint(run_dir, 64, params)
    by_split = {"train": 0.2, "held_out": 0.3}
    report = {"seed": 0, "trainer": "pose_mapper", "quality": by_split, "training_poses": 64, "versions": {"jax": "1"}}
    write_report(run_dir, report)
    rows = "".join(f"{64 * i},{1 / i:.4f},{1.2 / i:.4f}\n" for i in range(1, 6))
    (run_dir / METRICS).write_text(f"step,quality/quality.train,quality/quality.held_out\n{rows}")
    (run_dir / SWEEP).write_text('{"runs": [{"label": "seed=0", "overrides": ["seed=0"], "run_dir": "run"}]}\n')
    return run_dir


@functools.cache
def _template() -> Any:
    return PoseMapperTrainer(load_config(_good_run())).params_template()


@functools.cache
def _good_params() -> Any:
    return jax.device_get(load_checkpoint(_good_run(), _template())[1])


def _flip(data: bytes, rng: Generator) -> bytes:
    content = bytearray(data)
    for _ in range(rng.integers(1, 4)):
        content[int(rng.integers(len(content)))] ^= 1 << int(rng.integers(8))
    return bytes(content)


def _cut(data: bytes, rng: Generator) -> bytes:
    return data[: int(rng.integers(len(data)))]


def _insert(data: bytes, rng: Generator) -> bytes:
    place = int(rng.integers(len(data)))
    return data[:place] + _HOSTILE[int(rng.integers(len(_HOSTILE)))] + data[place:]


def _replace_value(data: bytes, rng: Generator) -> bytes:
    """A hostile value in place of what stands after a colon or comma."""
    places = [i for i, symbol in enumerate(data) if symbol in b":,"]
    start = places[int(rng.integers(len(places)))] + 1
    end = next((i for i in range(start, len(data)) if data[i] in b",\n}"), len(data))
    return data[:start] + b" " + _HOSTILE[int(rng.integers(len(_HOSTILE)))] + data[end:]


def _mix_lines(data: bytes, rng: Generator) -> bytes:
    lines = data.splitlines(keepends=True)
    chosen = rng.integers(len(lines), size=int(rng.integers(1, 2 * len(lines) + 1)))
    return b"".join(lines[int(i)] for i in chosen)


def _whole(data: bytes, rng: Generator) -> bytes:
    del data
    contents = (b"", b"\n", _BOMB, _REFERENCES, bytes(rng.bytes(1000)), b"[" * 50_000, b'{"a":' * 50_000, b"1", b"[]")
    return contents[int(rng.integers(len(contents)))]


_DAMAGES: tuple[Damage, ...] = (_flip, _cut, _insert, _replace_value, _replace_value, _mix_lines, _whole)


def _write_text(folder: Path, *, file: str, damage: Damage, rng: Generator) -> None:
    shutil.copytree(_good_run(), folder / RUN)
    place = folder if file == SWEEP else folder / RUN
    good = (folder / RUN / file).read_bytes()
    (folder / RUN / SWEEP).unlink()
    (place / file).write_bytes(damage(good, rng))


def _write_checkpoint(folder: Path, *, rng: Generator) -> None:
    shutil.copytree(_good_run(), folder / RUN)
    files = sorted(path for path in (folder / RUN / FOLDER).rglob("*") if path.is_file() and path.stat().st_size)
    file = files[int(rng.integers(len(files)))]
    kind = int(rng.integers(5))
    if kind == 0:
        file.unlink()
    elif kind == 1:
        file.write_bytes(bytes(rng.bytes(int(rng.integers(1, 5000)))))
    else:
        file.write_bytes((_cut, _flip, _flip)[kind - 2](file.read_bytes(), rng))


def _read_run(folder: Path) -> str:
    """Loads the config and collects the run; a config is accepted if all of its numbers are finite."""
    os.environ[SECRET_NAME] = SECRET
    try:
        prepare_collection(CollectConfig(folder=str(folder)))
        config = load_config(folder / RUN)
    finally:
        del os.environ[SECRET_NAME]
    values = flatten(to_dict(config)).values()
    is_finite = all(math.isfinite(value) for value in values if isinstance(value, int | float))
    return ACCEPTED if is_finite and SECRET not in str(config) else OTHER_NUMBERS


def _read_checkpoint(folder: Path) -> str:
    """Loads the checkpoint; it is accepted if its numbers are those that were saved."""
    _, params = load_checkpoint(folder / RUN, _template())
    equal = jax.tree.map(lambda a, b: bool(np.array_equal(a, b)), jax.device_get(params), _good_params())
    return ACCEPTED if all(jax.tree.leaves(equal)) else OTHER_NUMBERS
