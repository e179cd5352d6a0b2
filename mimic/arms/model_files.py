"""Reads MJCF and URDF files, and rejects unsafe ones with a one-line error before MuJoCo compiles them here."""

import contextlib
import functools
import logging
import os
import re
from collections.abc import Iterator
from pathlib import Path

import mujoco
import numpy as np

from mimic.arms.compile_check import VELOCITY_LIMIT, check_in_process, check_magnitudes
from mimic.arms.model_source import ModelSource, read_source
from mimic.arms.urdf import stated_velocities

_UNNAMED_MODEL = "MuJoCo Model"  # MuJoCo's name of a model without one
_MAX_MESSAGE = 400  # characters of MuJoCo's messages, which may repeat a whole attribute
_OWN_REASONS = ("the model ", "mujoco crashes")
_UNOPENED = re.compile(r"[Ee]rror opening file '([^']*)'")
_MASSLESS = "mass and inertia of moving bodies must be larger"

_log = logging.getLogger(__name__)


def read_spec(path: str | os.PathLike[str]) -> mujoco.MjSpec:
    """An MJCF or URDF file as a MuJoCo spec that compiles, in which every joint and body has a name.

    A URDF keeps the names of its fixed links and its velocity limits. Meshes that are missing or that MuJoCo cannot use
    are left out; what else is changed in it, a line says.

    Raises:
      ValueError: what `read_source` and `check_in_process` reject: MuJoCo compiles the file in another process first.
    """
    return _read(path)[0]


def read_model(path: str | os.PathLike[str]) -> mujoco.MjModel:
    """The compiled model of `read_spec`.

    Raises:
      ValueError: what `read_spec` rejects.
    """
    return _read(path)[1]


def model_name(model: mujoco.MjModel, path: str | os.PathLike[str] | None = None) -> str:
    """The model's own name; the name of its file where it has none."""
    name = model.names[: model.names.index(b"\0")].decode()
    return Path(path).stem if path is not None and name in ("", _UNNAMED_MODEL) else name


def _read(path: str | os.PathLike[str]) -> tuple[mujoco.MjSpec, mujoco.MjModel]:
    shown = repr(os.fspath(path))
    source = None if _is_bundled(Path(path)) else read_source(path)
    try:
        with _warnings_as_lines(shown):
            if source is None:
                spec = mujoco.MjSpec.from_file(os.fspath(path))
            else:
                if unusable := _check(source):
                    source = read_source(path, unusable)
                    _check(source)
                spec = _uncompiled(source)
            model = spec.compile()
            if _name_unnamed(spec):
                model = spec.compile()
            if source is not None:
                check_magnitudes(model)
                _warn(shown, (), tuple(_empty_ranges(model)))
    except (ValueError, mujoco.FatalError) as error:
        raise ValueError(_reason(shown, " ".join(str(error).split()))) from error
    if source is not None:
        _warn(shown, source.missing, source.notes)
    return spec, model


def _uncompiled(source: ModelSource) -> mujoco.MjSpec:
    spec = mujoco.MjSpec.from_string(source.text, include={name: xml.encode() for name, xml in source.texts.items()})
    if source.is_urdf:
        _restore_urdf_data(spec, source)
    return spec


@contextlib.contextmanager
def _warnings_as_lines(shown: str) -> Iterator[None]:
    """Logs MuJoCo's warnings about a model, which it would write to the terminal and a file."""
    warnings: list[str] = []
    mujoco.set_mju_user_warning(warnings.append)
    try:
        yield
    finally:
        mujoco.set_mju_user_warning(None)
        _warn(shown, (), tuple(dict.fromkeys(" ".join(warning.split()) for warning in warnings)))


def _is_bundled(file: Path) -> bool:
    """Whether a file is one of mimic's own models, which need no checks."""
    return os.path.dirname(os.path.realpath(file)) == os.path.realpath(Path(__file__).parents[1] / "xml")


@functools.cache  # a run reads a model several times
def _check(source: ModelSource) -> list[str]:
    """Checks a model; returns the meshes of a URDF without which it is to be read again."""
    meshes = [str(file) for file in source.files] if source.is_urdf else []
    return check_in_process(source.text, source.texts, meshes)


def _reason(shown: str, message: str) -> str:
    message = message if len(message) <= _MAX_MESSAGE else f"{message[:_MAX_MESSAGE]} ..."
    unopened = _UNOPENED.search(message)
    if unopened:
        return f"{shown} needs the file {unopened.group(1)!r}, which does not exist; expected all its files next to it"
    if _MASSLESS in message:
        return f"{shown} has a moving body without inertia; expected an <inertial>, or geoms with mass: {message}"
    if message.startswith(_OWN_REASONS):
        return f"{shown} is rejected: {message}"
    return f"{shown} is not an MJCF or URDF model that MuJoCo can read: {message}"


def _restore_urdf_data(spec: mujoco.MjSpec, source: ModelSource) -> None:
    """Names of fixed links and velocity limits, which MuJoCo drops from a URDF."""
    spec.compiler.fusestatic = False
    spec.compile()  # numbers the joints
    limits = stated_velocities(source.root)
    joints = sorted(spec.joints, key=lambda joint: joint.id)
    if joints:
        numeric = spec.add_numeric(name=VELOCITY_LIMIT, size=len(joints))
        numeric.data = [limits.get(joint.name, float("inf")) for joint in joints]


@functools.cache  # warns once, though a run reads a model several times
def _warn(shown: str, missing: tuple[str, ...], notes: tuple[str, ...]) -> None:
    if missing:
        _log.warning("%s: ignored %d meshes that cannot be read, the first %s", shown, len(missing), missing[0])
    for note in notes:
        _log.warning("%s: %s", shown, note)


def _empty_ranges(model: mujoco.MjModel) -> Iterator[str]:
    """Lines about joints whose range MuJoCo ignores, since it ends before it starts."""
    for joint in np.flatnonzero((model.jnt_limited == 0) & (model.jnt_range[:, 0] > model.jnt_range[:, 1])):
        low, high = model.jnt_range[joint]
        yield f"the range of joint {model.joint(joint).name!r} goes from {low:g} down to {high:g}: none is assumed"


def _name_unnamed(spec: mujoco.MjSpec) -> bool:
    """Names joints and bodies without a name by their number, from joint1 on; returns whether there were any."""
    unnamed = False
    for items, kind in ((spec.joints, "joint"), (spec.bodies[1:], "body")):
        names = {item.name for item in items}
        for number, item in enumerate(sorted(items, key=lambda item: item.id), start=1):
            if not item.name:
                item.name = _unique_name(f"{kind}{number}", names)
                names.add(item.name)
                unnamed = True
    return unnamed


def _unique_name(name: str, names: set[str]) -> str:
    while name in names:
        name += "_"
    return name
