"""Reads MJCF and URDF files with care: what cannot be meant is refused in one line before MuJoCo sees it."""

import functools
import logging
import os
import re
from collections.abc import Iterator
from pathlib import Path
from xml.etree import ElementTree

import mujoco

VELOCITY_LIMIT = "velocity_limit"  # the custom numeric that holds the rated speed of each joint [rad/s]
LARGEST_FILE = 32 * 2**20  # bytes of XML; the largest models of robots that we know have 1 MiB
_UNNAMED_MODEL = "MuJoCo Model"  # what MuJoCo calls a model that has no name

_log = logging.getLogger(__name__)
# By their text, since MuJoCo's own reader takes what a strict XML parser would not, such as "--" in a comment.
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

    A URDF keeps the names of its fixed links and its rated speeds; meshes that cannot be found are left out of it,
    since its inertias are given without them.

    Raises:
      ValueError: no such file, one that is too large, has entities or includes a file outside of its folder, or that
        MuJoCo cannot read.
    """
    return _read(path)[0]


def read_model(path: str | os.PathLike[str]) -> mujoco.MjModel:
    """The compiled model of `read_spec`.

    Raises:
      ValueError: what `read_spec` refuses.
    """
    return _read(path)[1]


def model_name(model: mujoco.MjModel, path: str | os.PathLike[str] | None = None) -> str:
    """The name that a model gives itself, else that of its file."""
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
            _keep_what_urdf_says(spec, file)
        model = spec.compile()
        if _name_unnamed(spec):
            model = spec.compile()
    except (ValueError, ElementTree.ParseError) as error:
        raise ValueError(_reason(shown, " ".join(str(error).split()))) from error
    return spec, model


def _reason(shown: str, message: str) -> str:
    unopened = _UNOPENED.search(message)
    if unopened:
        return f"{shown} needs the file {unopened.group(1)!r}, which is not there; expected all its files beside it"
    if _MASSLESS in message:
        return f"{shown} has a moving body without inertia; expected an <inertial>, or geoms to tell it from: {message}"
    return f"{shown} is no MJCF or URDF model that MuJoCo reads: {message}"


def _check_text(file: Path) -> None:
    """Refuses what no arm needs: huge files, entities, and includes that lead out of the folder of the model."""
    folder = file.resolve().parent
    pending, seen = [file.resolve()], set()
    while pending:
        part = pending.pop()
        if part in seen:
            continue
        seen.add(part)
        size = part.stat().st_size
        if size > LARGEST_FILE:
            raise ValueError(
                f"{str(part)!r} has {size / 2**20:.0f} MiB; "
                f"expected a model of at most {LARGEST_FILE // 2**20} MiB of XML"
            )
        text = _COMMENT.sub("", part.read_text(errors="replace"))
        if _DOCTYPE.search(text):
            raise ValueError(f"{str(part)!r} declares a document type or entities; expected plain MJCF or URDF")
        pending += _included(_INCLUDE.findall(text), part, folder)


def _included(names: list[str], part: Path, folder: Path) -> Iterator[Path]:
    """The files that a part of a model includes; what is not there is MuJoCo's to report."""
    for name in names:
        found = (folder / name).resolve()
        if not found.is_relative_to(folder):
            raise ValueError(
                f"{str(part)!r} includes {name!r}, which is outside of its folder; expected files in {str(folder)!r}"
            )
        if found.is_file():
            yield found


def _is_urdf(file: Path) -> bool:
    root = _ROOT.search(_COMMENT.sub("", file.read_text(errors="replace")))
    return root is not None and root.group(1) == "robot"


def _keep_what_urdf_says(spec: mujoco.MjSpec, file: Path) -> None:
    """Names of fixed links, rated speeds, and meshes where they are, which MuJoCo does not take from a URDF."""
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
        found = _find_mesh(mesh.file, folder / spec.meshdir, folder)
        if found is not None:
            mesh.file = str(found)
            continue
        missing.append(mesh.file)
        for geom in [geom for geom in spec.geoms if geom.meshname == mesh.name]:
            spec.delete(geom)
        spec.delete(mesh)
    if missing:
        _warn_of_missing(file, len(missing), missing[0])


@functools.cache  # a model is read several times in a run; once is enough to be told
def _warn_of_missing(file: Path, count: int, first: str) -> None:
    _log.warning("%s: left out %d meshes that cannot be read, the first %s", file, count, first)


def _find_mesh(name: str, *folders: Path) -> Path | None:
    """A mesh beside the model, or of a package that the model lies in."""
    package = _PACKAGE.match(name)
    if package:
        inside, rest = package.groups()
        parents = folders[-1].parents
        candidates = [parent / inside / rest for parent in parents] + [parent / rest for parent in parents]
    else:
        candidates = [folder / name.removeprefix("file://") for folder in folders]
    found = (path for path in candidates if path.is_file() and path.suffix.lower() in _MESH_FORMATS)
    return next(found, None)


def _name_unnamed(spec: mujoco.MjSpec) -> bool:
    """Names joints and bodies that have no name by their number, joint1 the first; whether there were any."""
    unnamed = False
    for items, kind in ((spec.joints, "joint"), (spec.bodies[1:], "body")):
        taken = {item.name for item in items}
        for number, item in enumerate(sorted(items, key=lambda item: item.id), start=1):
            if not item.name:
                item.name = _free_name(f"{kind}{number}", taken)
                taken.add(item.name)
                unnamed = True
    return unnamed


def _free_name(name: str, taken: set[str]) -> str:
    while name in taken:
        name += "_"
    return name
