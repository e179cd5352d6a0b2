"""The correspondence file of a run, kept in its directory: the run does not depend on the file it started from."""

import dataclasses
import os
from pathlib import Path

from mimic.base.files import read_bytes
from mimic.envs.config import EnvConfig
from mimic.metric.correspondence_files import SUFFIXES, is_correspondence_file

COPIES = tuple(f"correspondence{suffix}" for suffix in SUFFIXES)


def save_correspondence(run_dir: Path, env: EnvConfig) -> None:
    """Copies the correspondence file of an environment, if it has one that is not the copy."""
    name = env.metric.correspondence
    if not is_correspondence_file(name):
        return
    copy, original = _copy(run_dir, name), Path(name).expanduser()
    if os.path.abspath(copy) == os.path.abspath(original):
        return
    partial = copy.with_name(f"{copy.name}.partial")
    partial.write_bytes(read_bytes(original))
    os.replace(partial, copy)


def with_saved_correspondence(run_dir: Path, env: EnvConfig) -> EnvConfig:
    """The environment with the copy of its correspondence file, where there is one."""
    name = env.metric.correspondence
    if not is_correspondence_file(name) or not _copy(run_dir, name).is_file():
        return env
    metric = dataclasses.replace(env.metric, correspondence=str(_copy(run_dir, name)))
    return dataclasses.replace(env, metric=metric)


def _copy(run_dir: Path, name: str) -> Path:
    return run_dir / f"correspondence{Path(name).suffix}"
