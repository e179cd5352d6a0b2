"""Reads an MJCF or URDF file as the XML that MuJoCo will see: parsed, with its includes, and with its files located.

What MuJoCo reads is written from the parsed tree, so what is checked here is what it reads: no spelling of an include
or a path escapes the checks. What a model asks for in sizes is left to `compile_check`.
"""

import dataclasses
import hashlib
import os
import re
from collections.abc import Collection, Iterable, Mapping
from pathlib import Path
from typing import NoReturn
from xml.etree import ElementTree

from mimic.arms.urdf import is_xacro, mend_urdf
from mimic.base.files import check_file, file_digest, read_bytes

MAX_FILE_SIZE = 8 * 2**20  # bytes of XML; the largest robot models known to us have 1 MiB
MAX_ASSET_SIZE = 512 * 2**20  # bytes of all meshes, textures and height fields
MAX_ELEMENTS = 100_000  # XML elements
_PACKAGE_LEVELS = 4  # folders above a URDF in which its ROS package may be

_PACKAGE = re.compile(r"package:/+([^/]+)/(.*)", re.DOTALL)
_COMMENT = re.compile(r"""<!--.*?(?:-->|\Z)|\sxmlns=(?:"[^"]*"|'[^']*')""", re.DOTALL)  # or all elements' namespace
_TAG = re.compile(r"<[^<>]*>")
_MESH_FORMATS = (".stl", ".obj", ".msh")


@dataclasses.dataclass(frozen=True)
class ModelSource:
    """A model as MuJoCo reads it. Two sources are equal if their content is, files included.

    Attributes:
      digest: checksum of the XML and of all files.
      root: the XML, whose `file` attributes are absolute paths, or names of `attached`.
      files: the meshes, textures and height fields.
      missing: meshes of a URDF that were left out, since there is no such file or MuJoCo cannot use it.
      attached: the models that it attaches, by the names that it has for them.
      notes: what was changed or assumed in a URDF, one line each.
    """

    digest: str
    root: ElementTree.Element = dataclasses.field(compare=False)
    files: tuple[Path, ...] = dataclasses.field(compare=False)
    missing: tuple[str, ...] = dataclasses.field(compare=False)
    attached: Mapping[str, ElementTree.Element] = dataclasses.field(compare=False)
    notes: tuple[str, ...] = dataclasses.field(compare=False)

    @property
    def is_urdf(self) -> bool:
        """Whether it is a URDF."""
        return self.root.tag == "robot"

    @property
    def text(self) -> str:
        """The XML, with each element in the line that it has in its file, as far as there are no includes."""
        return ElementTree.tostring(self.root, "unicode")

    @property
    def texts(self) -> dict[str, str]:
        """The XML of the models that it attaches, by name."""
        return {name: ElementTree.tostring(root, "unicode") for name, root in self.attached.items()}


def read_source(path: str | os.PathLike[str], unusable: Collection[str] = ()) -> ModelSource:
    """Reads a model with all that it includes and attaches.

    Args:
      path: of the file.
      unusable: meshes that a URDF is to be read without, as absolute paths.

    Raises:
      ValueError: the file does not exist, is too large, no XML or a xacro, has entities, names two of its elements
        alike, or needs files that do not exist, are no regular files, or are outside its folder. The message is one
        line.
    """
    shown = repr(os.fspath(path))
    if not os.path.isfile(path):
        raise ValueError(f"no MJCF or URDF file at {shown}{', which is a folder' if os.path.isdir(path) else ''}")
    file = Path(os.path.realpath(path))
    reader = _Reader(shown, file.parent, unusable)
    try:
        root = reader.read(file)
        files = tuple(dict.fromkeys(reader.files))
        digest = hashlib.sha256(b"".join(map(ElementTree.tostring, [root, *reader.attached.values()])))
    except RecursionError:
        raise ValueError(f"{shown} has too many levels of XML") from None
    if (size := sum(file.stat().st_size for file in files)) > MAX_ASSET_SIZE:
        raise ValueError(f"{shown} has files of {size:,} bytes; expected at most {MAX_ASSET_SIZE:,}")
    for asset in files:
        digest.update(file_digest(asset).encode())
    notes = tuple(reader.notes)
    return ModelSource(digest.hexdigest(), root, files, tuple(reader.missing), reader.attached, notes)


class _Reader:
    """Reads a model.

    Args:
      shown: the model, for messages.
      folder: the folder that it and its includes are in; meshes and textures may also be next to it.
      unusable: meshes to leave out.
    """

    def __init__(self, shown: str, folder: Path, unusable: Collection[str]):
        self._shown = shown
        self._folder = folder
        self._unusable = unusable
        is_top = folder.parent == folder.parent.parent  # everything would be next to it
        self._package = folder if is_top else folder.parent
        self._places: dict[ElementTree.Element, Path] = {}  # files with an element that another file includes
        self.files: list[Path] = []
        self.missing: list[str] = []
        self.attached: dict[str, ElementTree.Element] = {}
        self.notes: list[str] = []

    def read(self, file: Path, parents: tuple[Path, ...] = ()) -> ElementTree.Element:
        """The tree of a model with its includes, whose files are located.

        Args:
          file: of the model.
          parents: the models that attach it.
        """
        root = self._with_includes(file)
        mesh_folder, texture_folder, strips_paths = _read_compilers(root)
        is_urdf = root.tag == "robot"
        if is_urdf:
            self._locate_urdf_meshes(root, (file.parent / mesh_folder, file.parent))
            self.notes += self._mended(root)
        for element in (part for model in (root.findall("mujoco") if is_urdf else [root]) for part in model.iter()):
            for attribute in [name for name in element.attrib if name.lower().startswith("file")]:
                if not (name := element.attrib[attribute]):
                    continue
                if element.tag.lower() == "model":
                    element.attrib[attribute] = self._attach(name, (*parents, file))
                    continue
                name = re.split(r"[/\\]", name)[-1] if strips_paths and not is_urdf else name
                folder = texture_folder if element.tag.lower() == "texture" else mesh_folder
                asset = self._file(name, (file.parent / folder, file.parent), self._package)
                element.attrib[attribute] = str(asset)
                self.files.append(asset)
        return root

    def _attach(self, name: str, parents: tuple[Path, ...]) -> str:
        """Reads a model that the last of `parents` attaches; returns its name among those attached."""
        part = self._file(name, (parents[-1].parent,), self._folder)
        if part in parents:
            raise ValueError(f"{self._unreadable}: it attaches {name!r:.200} to itself")
        root = self.read(part, parents)
        if root.tag != "mujoco":
            raise ValueError(f"{self._shown} attaches {name!r:.200}, which is no MJCF; expected MJCF")
        attached = f"{part.stem}-attached{len(self.attached)}.xml"
        self.attached[attached] = root
        return attached

    def _mended(self, root: ElementTree.Element) -> tuple[str, ...]:
        try:
            return mend_urdf(root)
        except ValueError as error:
            raise ValueError(f"{self._shown} is rejected: {error}") from None

    def _with_includes(self, file: Path) -> ElementTree.Element:
        """The tree of a file, with the content of each included file in its place."""
        included, root = {file}, self._parse(file)
        pending, count = [root], 0
        while pending:
            element = pending.pop()
            while any(child.tag.lower() == "include" for child in element):
                element[:] = [part for child in element for part in self._included(child, file, included)]
            pending += element
            count += 1
            if count > MAX_ELEMENTS:
                raise ValueError(f"{self._shown} has too many XML elements; expected at most {MAX_ELEMENTS:,}")
        return root

    def _included(self, element: ElementTree.Element, file: Path, included: set[Path]) -> Iterable[ElementTree.Element]:
        if element.tag.lower() != "include":
            return [element]
        name = element.get("file", "")
        part = self._file(name, (file.parent, self._places.get(element, file).parent), self._folder)
        if part in included:
            raise ValueError(f"{self._unreadable}: it includes {name!r:.200} twice")
        included.add(part)
        root = self._parse(part)
        self._places |= dict.fromkeys(root.iter("include"), part)
        for child in root.iter():
            child.text = child.tail = None  # lines of another file
        return root

    def _locate_urdf_meshes(self, root: ElementTree.Element, folders: tuple[Path, ...]) -> None:
        """Writes the paths of meshes into the model, and removes the shapes whose mesh does not exist."""
        for link in root.iter("link"):
            for shape in list(link):
                for mesh in shape.iter("mesh"):
                    name = mesh.get("filename", "")
                    file = self._urdf_mesh(name, folders)
                    if file is not None:
                        mesh.set("filename", str(file))
                        self.files.append(file)
                        continue
                    if shape.tag == "collision":
                        self.missing.append(name)
                    link.remove(shape)
                    break
        _child(_child(root, "mujoco"), "compiler").set("strippath", "false")

    def _urdf_mesh(self, name: str, folders: tuple[Path, ...]) -> Path | None:
        """A mesh relative to the model or within a ROS package around it; None where there is none."""
        if package := _PACKAGE.match(name):
            inside, rest = package.groups()
            parents = [parent for parent in self._folder.parents[:_PACKAGE_LEVELS] if parent != parent.parent]
            places = [(parent / inside, parent / inside / rest) for parent in parents]
            places += [(parent, parent / rest) for parent in parents]
        else:
            places = [(self._package, folder / name.removeprefix("file://")) for folder in folders]
        for bounds, place in places:
            path = Path(os.path.realpath(place))
            is_mesh = path.suffix.lower() in _MESH_FORMATS and path.is_file() and str(path) not in self._unusable
            if is_mesh and path.is_relative_to(os.path.realpath(bounds)):
                return path
        return None

    def _file(self, name: str, folders: tuple[Path, ...], bounds: Path) -> Path:
        """The path of a file that the model needs, in the first of some folders that has it."""
        paths = [Path(os.path.realpath(folder / name)) for folder in folders]
        path = next((path for path in paths if os.path.exists(path)), paths[0])
        if not path.is_relative_to(bounds):
            raise ValueError(
                f"{self._shown} needs {name!r:.200}, which is outside its folder; expected files in {str(bounds)!r}"
            )
        try:
            return check_file(path, MAX_ASSET_SIZE)
        except FileNotFoundError:
            raise ValueError(
                f"{self._shown} needs the file {name!r:.200}, which does not exist; expected all its files next to it"
            ) from None
        except (OSError, ValueError) as error:
            raise ValueError(f"{self._shown} needs {name!r:.200}, which cannot be read: {error!s:.200}") from None

    def _reject_xacro(self) -> NoReturn:
        raise ValueError(
            f"{self._shown} is a xacro, a template of a URDF; expand it first, with `xacro FILE -o arm.urdf` of ROS or "
            "`xacrodoc FILE -o arm.urdf` (pip install xacrodoc)"
        )

    @property
    def _unreadable(self) -> str:
        return f"{self._shown} is not an MJCF or URDF model that MuJoCo can read"

    def _parse(self, file: Path) -> ElementTree.Element:
        """The tree of a file. Comments are removed first: a strict parser rejects some that MuJoCo accepts."""
        try:
            content = read_bytes(file, MAX_FILE_SIZE)
        except (OSError, ValueError) as error:
            raise ValueError(f"{str(file)!r} cannot be read: {error}") from error
        try:
            text = content.decode("utf-8-sig")
        except UnicodeDecodeError:
            text = content.decode("latin-1")
        text = _COMMENT.sub(lambda comment: "\n" * comment[0].count("\n"), text)
        if "<!" in text:
            raise ValueError(f"{str(file)!r} declares a document type or entities; expected plain MJCF or URDF")
        # Line breaks of a tag are moved behind it: attributes lose theirs, and messages give the line.
        text = _TAG.sub(lambda tag: tag[0].replace("\n", " ") + "\n" * tag[0].count("\n"), text)
        try:
            root = ElementTree.fromstring(text.lstrip("\r\n\t ") if text.lstrip().startswith("<?xml") else text)
        except ElementTree.ParseError as error:
            if "unbound prefix" in str(error) and "<xacro:" in text:
                self._reject_xacro()
            raise ValueError(f"{self._unreadable}: {file.name!r}: {error}") from None
        if root.tag == "robot" and is_xacro(root):
            self._reject_xacro()
        for element in root.iter():
            for name, value in element.attrib.items():
                if not value.isprintable():  # a name must not break a message's line
                    element.attrib[name] = "".join(c if c.isprintable() else " " for c in value)
        return root


def _read_compilers(root: ElementTree.Element) -> tuple[str, str, bool]:
    """Folders of meshes and textures, and whether paths are stripped, which the last compiler that says so sets.

    Removes them from the model, whose files get absolute paths.
    """
    folders, strips = {"meshdir": "", "texturedir": ""}, "false"
    for compiler in (element for element in root.iter() if element.tag.lower() == "compiler"):
        common = compiler.attrib.pop("assetdir", None)
        for name in folders:
            folder = compiler.attrib.pop(name, common)
            folders[name] = folders[name] if folder is None else folder
        strips = compiler.attrib.pop("strippath", strips)
    return folders["meshdir"], folders["texturedir"], strips == "true"


def _child(element: ElementTree.Element, tag: str) -> ElementTree.Element:
    """The first child with a tag, which is added where there is none."""
    child = element.find(tag)
    if child is None:
        child = ElementTree.Element(tag)
        element.insert(0, child)
    return child
