"""Copies of model files, with all that they need, in a folder of their own."""

import copy
from collections.abc import Mapping
from pathlib import Path
from xml.etree import ElementTree

from mimic.arms.model_source import ModelSource

_ASSETS = "assets"


def copied_files(source: ModelSource, name: str) -> Mapping[str, bytes | Path]:
    """The files of a model that needs no others, by their paths in its folder: contents, or files to copy.

    Args:
      source: the model.
      name: of the copied MJCF or URDF file; its stem names an arm without a name.
    """
    # The names of the files stay, since MuJoCo names meshes by them.
    places = {str(file): f"{_ASSETS}/{number}/{file.name}" for number, file in enumerate(source.files)}
    files: dict[str, bytes | Path] = {place: Path(file) for file, place in places.items()}
    for file, root in {**source.attached, name: source.root}.items():
        files[file] = ElementTree.tostring(_with_paths(root, places))
    return files


def _with_paths(root: ElementTree.Element, places: Mapping[str, str]) -> ElementTree.Element:
    """The model with relative paths of its files."""
    copied = copy.deepcopy(root)
    for element in copied.iter():
        for attribute, value in element.attrib.items():
            if attribute.lower().startswith("file"):
                element.attrib[attribute] = places.get(value, value)
    return copied
