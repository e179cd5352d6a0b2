"""Reads an MJCF or URDF file as the XML that MuJoCo will see: parsed, with its includes, and with its files located.

What MuJoCo reads is written from the parsed tree, so what is checked here is what it reads: no spelling of an include
or a path escapes the checks.
"""

import dataclasses
import hashlib
import math
import os
import re
import stat
from collections.abc import Iterator
from pathlib import Path
from xml.parsers import expat

from mimic.base.files import file_digest, read_bytes

MAX_FILE_SIZE = 32 * 2**20  # bytes of XML; the largest robot models known to us have 1 MiB
MAX_ASSET_SIZE = 512 * 2**20  # bytes of all meshes, textures and height fields
MAX_DEPTH = 300  # levels of XML
MAX_ELEMENTS = 100_000  # XML elements, those that <replicate> repeats counted as often as it does
MAX_ATTRIBUTES = 1000  # of an element
MAX_PARTS = 200  # files that a model includes; models that it attaches
MAX_PIXELS = 2**24  # of a texture
MAX_GRID = 2**22  # points of a height field
MAX_COUNT = 1000  # copies by <replicate>, elements of a <composite> or <flexcomp>, values of a <numeric>, keyframes
_MAX_NESTED = 10  # levels of models that attach others
_PACKAGE_LEVELS = 4  # folders above a URDF in which its ROS package may be

_PACKAGE = re.compile(r"package:/+([^/]+)/(.*)", re.DOTALL)
_MESH_FORMATS = (".stl", ".obj", ".msh")
_FOLDERS = {"texture": "texturedir"}  # attribute of the compiler with the folder of an element's files
_MESH_FOLDER = "meshdir"


@dataclasses.dataclass
class Element:
    """An XML element without its text, which neither MJCF nor URDF uses."""

    tag: str
    attributes: dict[str, str]
    line: int
    children: list["Element"] = dataclasses.field(default_factory=list)

    @property
    def kind(self) -> str:
        """The tag in lower case: MuJoCo includes files by <INCLUDE> too."""
        return self.tag.lower()

    def walk(self) -> Iterator["Element"]:
        """This element and all within it, in the order of the file."""
        pending = [self]
        while pending:
            element = pending.pop()
            yield element
            pending += element.children[::-1]


@dataclasses.dataclass(frozen=True)
class ModelSource:
    """A model as MuJoCo reads it. Two sources are equal if their content is, files included.

    Attributes:
      digest: checksum of the XML and of all files.
      root: the XML, whose `file` attributes are absolute paths, or names in `attached`.
      attached: other models that this one attaches, by the names that it has for them.
      files: the meshes, textures and height fields.
      missing: meshes of a URDF that were left out, since there is no such file.
    """

    digest: str
    root: Element = dataclasses.field(compare=False)
    attached: dict[str, Element] = dataclasses.field(compare=False)
    files: tuple[Path, ...] = dataclasses.field(compare=False)
    missing: tuple[str, ...] = dataclasses.field(compare=False)

    @property
    def is_urdf(self) -> bool:
        """Whether it is a URDF."""
        return self.root.tag == "robot"

    @property
    def text(self) -> str:
        """The XML, with each element in the line that it has in its file, as far as there are no includes."""
        return write_xml(self.root)

    @property
    def attached_texts(self) -> dict[str, bytes]:
        """The XML of the attached models."""
        return {name: write_xml(root).encode() for name, root in self.attached.items()}


def read_source(path: str | os.PathLike[str]) -> ModelSource:
    """Reads a model with all that it includes.

    Raises:
      ValueError: the file does not exist, is too large or no XML, has entities, or needs files that do not exist, are
        no regular files, or are outside its folder; or it repeats elements too often, or has huge textures. The
        message is one line.
    """
    try:
        return _source(_Reader(Path(path)))
    except OSError as error:
        raise ValueError(f"{os.fspath(path)!r} cannot be read: {error.strerror}: {error.filename!r}") from error


def _source(reader: "_Reader") -> ModelSource:
    root = reader.read()
    files = tuple(dict.fromkeys(reader.files))
    size = sum(file.stat().st_size for file in files)
    if size > MAX_ASSET_SIZE:
        raise ValueError(
            f"{reader.shown} has files of {size / 2**20:.0f} MiB; expected at most {MAX_ASSET_SIZE // 2**20} MiB"
        )
    digest = hashlib.sha256()
    for text in (root, *reader.attached.values()):
        digest.update(write_xml(text).encode() + b"\0")
    for file in files:
        digest.update(file_digest(file).encode())
    return ModelSource(digest.hexdigest(), root, reader.attached, files, tuple(reader.missing))


def write_xml(root: Element) -> str:
    """An element as XML, each element in its line as far as possible: MuJoCo's messages give the line."""
    parts: list[str] = []
    line = 1
    pending: list[Element | str] = [root]
    while pending:
        element = pending.pop()
        if isinstance(element, str):
            parts.append(element)
            continue
        if element.line > line:
            parts.append("\n" * (element.line - line))
            line = element.line
        attributes = "".join(f' {name}="{_escaped(value)}"' for name, value in element.attributes.items())
        parts.append(f"<{element.tag}{attributes}{'>' if element.children else '/>'}")
        if element.children:
            pending += [f"</{element.tag}>", *reversed(element.children)]
    return "".join(parts)


def _escaped(value: str) -> str:
    for character, entity in (("&", "&amp;"), ("<", "&lt;"), (">", "&gt;"), ('"', "&quot;")):
        value = value.replace(character, entity)
    return value


class _Reader:
    """Reads one model; `folder` is the one that its includes are in."""

    def __init__(self, path: Path, folder: Path | None = None, models: tuple[Path, ...] = ()):
        self.shown = repr(str(path))
        if not path.is_file():
            raise ValueError(f"no MJCF or URDF file at {self.shown}{', which is no file' if _is_there(path) else ''}")
        self._file = path.resolve()
        self._folder = self._file.parent
        self._bounds = folder or self._folder
        self._models = (*models, self._file)
        self._included = {self._file}
        self._elements = 0.0
        self._asset_folders = {name: self._folder for name in (_MESH_FOLDER, *_FOLDERS.values())}
        self._strips_paths = False
        self.attached: dict[str, Element] = {}
        self.files: list[Path] = []
        self.missing: list[str] = []

    def read(self) -> Element:
        root = self._with_includes(self._parse(self._file))
        is_urdf = root.tag == "robot"
        self._check_sizes(root)
        self._read_compiler(root)
        if is_urdf:
            self._locate_urdf_meshes(root)
        for model in [element for element in root.children if element.kind == "mujoco"] if is_urdf else [root]:
            self._locate_files(model)
        return root

    # --- XML ---

    def _parse(self, file: Path) -> Element:
        """The elements of a file; comments are removed where a strict parser rejects them, which MuJoCo does not."""
        text = self._text(file)
        try:
            try:
                return _parse(text)
            except expat.ExpatError:
                return _parse(_without_comments(text))
        except (expat.ExpatError, ValueError) as error:
            place = "" if file == self._file else f"in {file.name!r}: "
            if isinstance(error, expat.ExpatError):
                raise ValueError(
                    f"{self.shown} is not an MJCF or URDF model that MuJoCo can read: {place}{error}"
                ) from None
            raise ValueError(f"{str(file)!r} {error}") from None

    def _text(self, file: Path) -> str:
        try:
            content = read_bytes(file, MAX_FILE_SIZE)
        except ValueError as error:
            raise ValueError(f"{str(file)!r} cannot be read: {error}") from error
        try:
            return content.decode("utf-8-sig")
        except UnicodeDecodeError:
            return content.decode("latin-1")

    def _with_includes(self, root: Element) -> Element:
        """The tree with the content of each included file in its place."""
        pending = [root]
        while pending:
            element = pending.pop()
            self._count(1)
            while any(child.kind == "include" for child in element.children):
                element.children = [part for child in element.children for part in self._included_elements(child)]
            pending += element.children
        return root

    def _included_elements(self, element: Element) -> list[Element]:
        if element.kind != "include":
            return [element]
        name = element.attributes.get("file", "")
        file = self._regular_file(name, self._folder / name, (self._bounds,), "includes")
        if file in self._included:
            raise ValueError(
                f"{self.shown} is not an MJCF or URDF model that MuJoCo can read: it includes {name!r} twice"
            )
        if len(self._included) > MAX_PARTS:
            raise ValueError(f"{self.shown} includes too many files; expected at most {MAX_PARTS}")
        self._included.add(file)
        children = self._parse(file).children
        for child in children:
            for part in child.walk():
                part.line = 0  # a line of another file
        return children

    def _count(self, count: float) -> None:
        self._elements += count
        if self._elements > MAX_ELEMENTS:
            raise ValueError(f"{self.shown} has too many XML elements; expected at most {MAX_ELEMENTS:,}")

    def _check_sizes(self, root: Element) -> None:
        """Bounds what a few characters can ask for: repeated elements, textures and grids."""
        pending: list[tuple[Element, float]] = [(root, 1)]
        while pending:
            element, times = pending.pop()
            self._count(times)
            if element.kind == "replicate":
                self._limit(element, "count", MAX_COUNT, times)
                times *= max(_size(element, "count"), 1)
            elif element.kind == "size":
                for name in ("nkey", *(name for name in element.attributes if name.startswith("nuser"))):
                    self._limit(element, name, MAX_COUNT)
            elif element.kind in ("composite", "flexcomp"):
                self._limit(element, "count", MAX_COUNT)
            elif element.kind == "texture":
                self._limit(element, "width height", MAX_PIXELS)
            elif element.kind == "hfield":
                self._limit(element, "nrow ncol", MAX_GRID)
            elif element.kind == "numeric":
                self._limit(element, "size", MAX_COUNT)
            pending += [(child, times) for child in element.children]

    def _limit(self, element: Element, names: str, maximum: int, times: float = 1) -> None:
        size = times * math.prod(_size(element, name) for name in names.split())
        if size > maximum:
            raise ValueError(
                f"{self.shown} has <{element.kind}> with {names.replace(' ', ' x ')} = {size:.6g}; "
                f"expected at most {maximum:,}"
            )

    # --- files ---

    def _read_compiler(self, root: Element) -> None:
        """Folders of the assets, which the last compiler element that names them sets; removes them from the model."""
        folders: dict[str, str] = {}
        strips = "true" if root.tag == "robot" else "false"
        for compiler in (element for element in root.walk() if element.kind == "compiler"):
            common = compiler.attributes.pop("assetdir", None)
            for name in self._asset_folders:
                folder = compiler.attributes.pop(name, common)
                folders |= {} if folder is None else {name: folder}
            strips = compiler.attributes.pop("strippath", strips)
        self._strips_paths = strips == "true" and root.tag != "robot"
        for name, folder in folders.items():
            path = self._resolved(self._folder / folder)
            if path is None or not path.is_relative_to(_package(self._bounds)):
                raise ValueError(
                    f"{self.shown} has {name}={folder!r}, which is outside; expected a folder in {str(self._folder)!r} "
                    "or next to it"
                )
            self._asset_folders[name] = path

    def _locate_files(self, root: Element) -> None:
        for element in root.walk():
            for attribute in [name for name in element.attributes if name.lower().startswith("file")]:
                name = element.attributes[attribute]
                if not name:
                    continue
                if element.kind == "model":
                    element.attributes[attribute] = self._attach(name)
                    continue
                name = re.split(r"[/\\]", name)[-1] if self._strips_paths else name
                folder = self._asset_folders[_FOLDERS.get(element.kind, _MESH_FOLDER)]
                candidates = (folder / name, self._folder / name)
                path = next((path for path in candidates if _is_there(path)), candidates[0])
                file = self._regular_file(name, path, (self._bounds, folder), "needs")
                element.attributes[attribute] = str(file)
                self.files.append(file)

    def _attach(self, name: str) -> str:
        """Reads a model that this one attaches; returns the name that MuJoCo finds it by."""
        file = self._regular_file(name, self._folder / name, (self._bounds,), "attaches")
        if file in self._models:
            raise ValueError(f"{self.shown} attaches {name!r}, which contains it")
        if len(self._models) > _MAX_NESTED or len(self.attached) >= MAX_PARTS:
            raise ValueError(f"{self.shown} attaches too many models; expected at most {_MAX_NESTED} levels")
        reader = _Reader(file, self._bounds, self._models)
        root = reader.read()
        self.files += reader.files
        self.attached |= reader.attached
        self._count(reader._elements)
        key = f"attached-{hashlib.sha256(str(file).encode()).hexdigest()[:16]}.xml"
        self.attached[key] = root
        return key

    def _locate_urdf_meshes(self, root: Element) -> None:
        """Writes the paths of meshes into the model, and removes the shapes whose mesh does not exist."""
        folders = (self._asset_folders[_MESH_FOLDER], self._folder)
        for link in (element for element in root.walk() if element.kind == "link"):
            kept = []
            for shape in link.children:
                meshes = [element for element in shape.walk() if element.kind == "mesh"]
                files = [self._urdf_mesh(mesh.attributes.get("filename", ""), folders) for mesh in meshes]
                lacking = [mesh for mesh, file in zip(meshes, files, strict=True) if file is None]
                if lacking and shape.tag == "collision":
                    self.missing.append(lacking[0].attributes.get("filename", ""))
                if lacking:
                    continue
                for mesh, file in zip(meshes, filter(None, files), strict=True):
                    mesh.attributes["filename"] = str(file)
                    self.files.append(file)
                kept.append(shape)
            link.children = kept
        _child(_child(root, "mujoco"), "compiler").attributes["strippath"] = "false"

    def _urdf_mesh(self, name: str, folders: tuple[Path, ...]) -> Path | None:
        """A mesh relative to the model or within a ROS package around it; None where there is none."""
        package = _PACKAGE.match(name)
        if package:
            inside, rest = package.groups()
            parents = [parent for parent in self._folder.parents[:_PACKAGE_LEVELS] if parent != parent.parent]
            candidates = [(parent / inside / rest, parent / inside) for parent in parents]
            candidates += [(parent / rest, parent) for parent in parents]
        else:
            candidates = [(folder / name.removeprefix("file://"), _package(self._bounds)) for folder in folders]
        for path, bounds in candidates:
            file = self._resolved(path)
            is_mesh = file is not None and file.suffix.lower() in _MESH_FORMATS and _is_regular(file)
            if is_mesh and file is not None and file.is_relative_to(self._resolved(bounds) or bounds):
                return file
        return None

    def _regular_file(self, name: str, path: Path, folders: tuple[Path, ...], verb: str) -> Path:
        """The path of a file that the model needs, which must exist in one of some folders."""
        file = self._resolved(path)
        if file is None or not any(file.is_relative_to(folder) for folder in folders):
            raise ValueError(
                f"{self.shown} {verb} {name!r}, which is outside its folder; expected files in {str(folders[0])!r}"
            )
        if not _is_there(file):
            raise ValueError(
                f"{self.shown} needs the file {name!r}, which does not exist; expected all its files next to it"
            )
        if not _is_regular(file):
            raise ValueError(f"{self.shown} {verb} {name!r}, which is not a regular file")
        return file

    @staticmethod
    def _resolved(path: Path) -> Path | None:
        try:
            return path.resolve()
        except (OSError, RuntimeError, ValueError):  # a loop of links, or a name that no file can have
            return None


def _child(element: Element, tag: str) -> Element:
    """The first child with a tag, which is added where there is none."""
    child = next((child for child in element.children if child.tag == tag), None)
    if child is None:
        child = Element(tag, {}, 0)
        element.children.insert(0, child)
    return child


def _parse(text: str) -> Element:
    """The tree of elements of an XML text.

    Raises:
      ValueError: a document type or entities, or too many levels.
      ExpatError: it is no XML.
    """
    parser = expat.ParserCreate("utf-8")
    document = Element("", {}, 0)
    line = [document]  # from the document to the open element

    count = 0

    def start(tag: str, attributes: dict[str, str]) -> None:
        nonlocal count
        count += 1
        if count > MAX_ELEMENTS or len(attributes) > MAX_ATTRIBUTES:
            raise ValueError(f"has too many XML elements or attributes; expected at most {MAX_ELEMENTS:,}")
        if len(line) > MAX_DEPTH:
            raise ValueError(f"has more than {MAX_DEPTH} levels of XML")
        printable = {name: _printable(value) for name, value in attributes.items()}
        element = Element(tag, printable, parser.CurrentLineNumber)
        line[-1].children.append(element)
        line.append(element)

    def reject(*_: object) -> None:
        raise ValueError("declares a document type or entities; expected plain MJCF or URDF")

    parser.StartElementHandler = start
    parser.EndElementHandler = lambda _: line.pop()
    parser.StartDoctypeDeclHandler = reject
    parser.EntityDeclHandler = reject
    parser.Parse(text.lstrip().encode(), True)  # MuJoCo accepts space before the XML declaration
    return document.children[0]


def _printable(value: str) -> str:
    """The value with a space for each character that cannot be printed: a name must not break a message's line."""
    return value if value.isprintable() else "".join(c if c.isprintable() else " " for c in value)


def _without_comments(text: str) -> str:
    """The text without comments, but with their line breaks."""
    parts, position = [], 0
    while (start := text.find("<!--", position)) >= 0:
        end = text.find("-->", start + 4)
        parts.append(text[position:start])
        position = len(text) if end < 0 else end + 3
        parts.append("\n" * text.count("\n", start, position))
    return "".join([*parts, text[position:]])


def _size(element: Element, name: str) -> float:
    """The product of an attribute's numbers; 0 where there are none, or text that MuJoCo will reject."""
    try:
        return abs(math.prod(map(float, element.attributes[name].split())))
    except (KeyError, ValueError):
        return 0


def _package(folder: Path) -> Path:
    """The folder of the package that a model's folder is part of: the one around it, unless that is the root."""
    return folder.parent if folder.parent != folder.parent.parent else folder


def _is_there(path: Path) -> bool:
    try:
        return path.exists()
    except (OSError, ValueError):
        return False


def _is_regular(path: Path) -> bool:
    try:
        return stat.S_ISREG(path.stat().st_mode)
    except (OSError, ValueError):
        return False
