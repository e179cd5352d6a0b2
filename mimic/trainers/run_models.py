"""The model files of a run's own arms, kept in its directory: the run does not depend on the files it started from."""

import dataclasses
import json
import os
import shutil
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from mimic.arms.arm import ArmConfig
from mimic.arms.model_copy import copied_files
from mimic.arms.model_source import read_source
from mimic.base.files import file_digest, read_bytes, read_json, write_atomically
from mimic.envs.config import EnvConfig
from mimic.envs.family import arm_name

MODELS, RECORD = "models", "models.json"
_ROLES, _LISTS = ("expert", "learner"), ("models", "evaluated")  # fields of EnvConfig, and lists of ArmsConfig


def save_models(run_dir: Path, env: EnvConfig) -> None:
    """Copies the model files of the arms into the folder `models`; a run whose arms are from there keeps them.

    Where the learner is drawn for each episode, these are also the files of `arms.models` and `arms.evaluated`.

    The file `models.json` records the original paths and the checksums of the copies. The folder has its final name
    only when it is complete.

    Raises:
      ValueError: a file that cannot be read any more.
    """
    arms = own_arms(env)
    folder = run_dir / MODELS
    if not arms or any(Path(arm.model).is_relative_to(os.path.abspath(folder)) for arm in arms.values()):
        return
    partial = run_dir / f"{MODELS}.partial"
    shutil.rmtree(partial, ignore_errors=True)
    for role, arm in arms.items():
        for name, content in copied_files(read_source(arm.model), Path(arm.model).name).items():
            place = partial / role / name
            place.parent.mkdir(parents=True, exist_ok=True)
            if isinstance(content, bytes):
                place.write_bytes(content)
            else:
                place.write_bytes(read_bytes(content))
    record = {
        "arms": {role: {"file": f"{role}/{Path(arm.model).name}", "original": arm.model} for role, arm in arms.items()},
        "sha256": {str(path.relative_to(partial)): file_digest(path) for path in _files(partial)},
    }
    write_atomically(partial / RECORD, json.dumps(record, indent=2) + "\n")
    shutil.rmtree(folder, ignore_errors=True)  # of a run that ended before it had a config
    os.replace(partial, folder)


def with_saved_models(run_dir: Path, env: EnvConfig) -> EnvConfig:
    """The environment with the arms of the folder `models`; unchanged for a run without this folder.

    Raises:
      ValueError: the folder was changed.
    """
    arms, folder = own_arms(env), run_dir / MODELS
    if not arms or not folder.exists():
        return env
    record = _read_record(folder)
    _check_files(folder, record["sha256"])
    models: dict[str, str] = {}
    for role in arms:
        file = record["arms"].get(role, {}).get("file")
        if file not in record["sha256"]:
            raise ValueError(f"{str(folder / RECORD)!r} has no model of the {role}; {_ADVICE}")
        models[role] = str(folder / file)
    return _with_models(env, models)


def with_original_models(env: EnvConfig) -> EnvConfig:
    """The inverse of `with_saved_models`: with the files that the run started from."""
    return _with_models(env, {role: _original(arm, role).model for role, arm in own_arms(env).items()})


def _with_models(env: EnvConfig, models: Mapping[str, str]) -> EnvConfig:
    """The environment with other files of its own arms, by their role."""
    changes: dict[str, Any] = {
        role: dataclasses.replace(getattr(env, role), model=models[role]) for role in _ROLES if role in models
    }
    if env.arms is not None:
        lists = {key: [models.get(_role(name), name) for name in getattr(env.arms, key)] for key in _LISTS}
        changes["arms"] = dataclasses.replace(env.arms, **lists)
    return dataclasses.replace(env, **changes)


def _original(arm: ArmConfig, role: str) -> ArmConfig:
    folder = Path(arm.model).parents[1] if len(Path(arm.model).parents) > 1 else Path()
    if folder.name != MODELS or Path(arm.model).parent.name != role or not (folder / RECORD).is_file():
        return arm
    return dataclasses.replace(arm, model=_read_record(folder)["arms"][role]["original"])


_ADVICE = "copy the run again, or remove this folder to use the files that the run's config names"


def own_arms(env: EnvConfig) -> dict[str, ArmConfig]:
    """The arms that are read from files by their role: expert, learner, or the folder of one of many arms.

    Raises:
      ValueError: several files of one name among the many, or one that is named like a role.
    """
    arms = {role: arm for role in _ROLES if (arm := getattr(env, role)).is_file}
    for name in (name for key in _LISTS for name in getattr(env.arms, key, ())):
        arm, role = ArmConfig(model=name), _role(name)
        if arm.is_file and role in _ROLES:
            raise ValueError(f"arms: expected a file of another name than expert and learner, got {arm.model!r}")
        if arm.is_file and arms.setdefault(role, arm).model != arm.model:
            raise ValueError(f"arms: expected files of different names, got {arms[role].model!r} and {arm.model!r}")
    return arms


def _role(name: str) -> str:
    """The folder of one of many arms: its name in the report, so that its copy has the same name."""
    return arm_name(ArmConfig(model=name))


def _files(folder: Path) -> list[Path]:
    return sorted(path for path in folder.rglob("*") if not path.is_dir())


def _read_record(folder: Path) -> Mapping[str, Any]:
    path = folder / RECORD
    try:
        record = read_json(path)
        for role, arm in record["arms"].items():
            if not (isinstance(arm["file"], str) and isinstance(arm["original"], str)):
                raise ValueError(f"unexpected entry {role!r}")
        if not all(isinstance(text, str) for entry in record["sha256"].items() for text in entry):
            raise ValueError("expected checksums of files")
    except (ValueError, OSError, KeyError, TypeError, AttributeError, RecursionError) as error:
        reason = " ".join(str(error).split())
        raise ValueError(f"{str(path)!r} cannot be read: {reason}; {_ADVICE}") from error
    return record


def _check_files(folder: Path, expected: Mapping[str, str]) -> None:
    """Rejects a folder whose files are not those that the record lists."""
    files = [path for path in _files(folder) if path != folder / RECORD]
    names = {str(path.relative_to(folder)) for path in files}
    for name in sorted(names ^ set(expected)):
        what = "is missing" if name in expected else "was added"
        raise ValueError(f"{str(folder / name)!r} {what} since the training started; {_ADVICE}")
    for path in files:
        name = str(path.relative_to(folder))
        is_same = path.is_file() and not path.is_symlink() and file_digest(path) == expected[name]
        if not is_same:
            raise ValueError(f"{str(path)!r} was changed since the training started; {_ADVICE}")
