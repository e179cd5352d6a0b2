"""Reads MJCF and URDF files, and rejects unsafe ones with a one-line error before MuJoCo parses them."""

import functools
import logging
import os
import re
from collections.abc import Iterator
from pathlib import Path
from xml.etree import ElementTree

import mujoco

VELOCITY_LIMIT = "velocity_limit"  # custom numeric with the velocity limit of each joint [rad/s]
MAX_FILE_SIZE = 32 * 2**20  # bytes of XML; the largest robot models known to us have 1 MiB
_UNNAMED_MODEL = "MuJoCo Model"  # MuJoCo's name of a model without one

_log = logging.getLogger(__name__)
# Regular expressions, since MuJoCo's own reader accepts text that a strict XML parser rejects: "--" in a comment.
_COMMENT = re.compile(r"<!--.*?-->", re.DOTALL)
_DOCTYPE = re.compile(r"<!\s*(DOCTYPE|ENTITY)", re.IGNORECASE)
_ROOT = re.compile(r"<\s*(robot|mujoco)\b")
_INCLUDE = re.compile(r"<include\b[^>]*?\bfile\s*=\s*[\"']([^\"']*)[\"']")
_PACKAGE = re.compile(r"package:/+([^/]+)/(.*)")
_UNOPENED = re.compile(r"[Ee]rror opening file '([^']*)'")
_MASSLESS = "mass and inertia of moving bodies must be larger"
_MESH_FORMATS = (".stl", ".obj", ".msh")


def read_spec(path: str | os.PathLike[str]) -> mujoco.MjSpec:
    """An MJCF or URDF file as a MuJoCo spec that compiles, in which every joint and body has a name.

    A URDF keeps the names of its fixed links and its velocity limits. Its missing meshes are left out, since the file
    states the inertias itself.

    Raises:
      ValueError: the file does not exist, is too large, has entities, includes a file outside its folder, or MuJoCo
        cannot read it.
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
    file = Path(path)
    shown = repr(os.fspath(path))
    if not file.is_file():
        raise ValueError(f"no MJCF or URDF file at {shown}")
    _check_text(file)
    try:
        spec = mujoco.MjSpec.from_file(os.fspath(path))
        if _is_urdf(file):
            _restore_urdf_data(spec, file)
        model = spec.compile()
        if _name_unnamed(spec):
            model = spec.compile()
    except (ValueError, ElementTree.ParseError) as error:
        raise ValueError(_reason(shown, " ".join(str(error).split()))) from error
    return spec, model


def _reason(shown: str, message: str) -> str:
    unopened = _UNOPENED.search(message)
    if unopened:
        return f"{shown} needs the file {unopened.group(1)!r}, which does not exist; expected all its files next to it"
    if _MASSLESS in message:
        return f"{shown} has a moving body without inertia; expected an <inertial>, or geoms with mass: {message}"
    return f"{shown} is not an MJCF or URDF model that MuJoCo can read: {message}"


def _check_text(file: Path) -> None:
    """Rejects huge files, entities, and includes that lead out of the folder of the model; no arm needs them."""
    folder = file.resolve().parent
    pending, checked = [file.resolve()], set()
    while pending:
        part = pending.pop()
        if part in checked:
            continue
        checked.add(part)
        size = part.stat().st_size
        if size > MAX_FILE_SIZE:
            raise ValueError(
                f"{str(part)!r} has {size / 2**20:.0f} MiB; "
                f"expected a model of at most {MAX_FILE_SIZE // 2**20} MiB of XML"
            )
        text = _COMMENT.sub("", part.read_text(errors="replace"))
        if _DOCTYPE.search(text):
            raise ValueError(f"{str(part)!r} declares a document type or entities; expected plain MJCF or URDF")
        pending += _included(_INCLUDE.findall(text), part, folder)


def _included(names: list[str], part: Path, folder: Path) -> Iterator[Path]:
    """The files that a part of a model includes; MuJoCo reports those that do not exist."""
    for name in names:
        included = (folder / name).resolve()
        if not included.is_relative_to(folder):
            raise ValueError(
                f"{str(part)!r} includes {name!r}, which is outside its folder; expected files in {str(folder)!r}"
            )
        if included.is_file():
            yield included


def _is_urdf(file: Path) -> bool:
    root = _ROOT.search(_COMMENT.sub("", file.read_text(errors="replace")))
    return root is not None and root.group(1) == "robot"


def _restore_urdf_data(spec: mujoco.MjSpec, file: Path) -> None:
    """Names of fixed links, velocity limits, and paths of meshes, which MuJoCo drops from a URDF."""
    spec.compiler.fusestatic = False
    _find_meshes(spec, file)
    spec.compile()  # numbers the joints
    limits = {
        joint.get("name"): float(limit.get("velocity", 0))
        for joint in ElementTree.parse(file).getroot().iter("joint")
        if (limit := joint.find("limit")) is not None
    }
    joints = sorted(spec.joints, key=lambda joint: joint.id)
    if joints:
        numeric = spec.add_numeric(name=VELOCITY_LIMIT, size=len(joints))
        numeric.data = [limits.get(joint.name, 0.0) or float("inf") for joint in joints]


def _find_meshes(spec: mujoco.MjSpec, file: Path) -> None:
    folder, missing = file.resolve().parent, []
    for mesh in list(spec.meshes):
        path = _find_mesh(mesh.file, folder / spec.meshdir, folder)
        if path is not None:
            mesh.file = str(path)
            continue
        missing.append(mesh.file)
        for geom in [geom for geom in spec.geoms if geom.meshname == mesh.name]:
            spec.delete(geom)
        spec.delete(mesh)
    if missing:
        _warn_missing_meshes(file, len(missing), missing[0])


@functools.cache  # warns once, though a run reads a model several times
def _warn_missing_meshes(file: Path, count: int, first: str) -> None:
    _log.warning("%s: ignored %d meshes that cannot be read, the first %s", file, count, first)


def _find_mesh(name: str, *folders: Path) -> Path | None:
    """Path of a mesh, relative to the model or within a ROS package around it."""
    package = _PACKAGE.match(name)
    if package:
        inside, rest = package.groups()
        parents = folders[-1].parents
        candidates = [parent / inside / rest for parent in parents] + [parent / rest for parent in parents]
    else:
        candidates = [folder / name.removeprefix("file://") for folder in folders]
    meshes = (path for path in candidates if path.is_file() and path.suffix.lower() in _MESH_FORMATS)
    return next(meshes, None)


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
