"""Imports of the package run one way: a folder imports only from those below it, and there are no circular imports.

Imports within functions and imports for type checkers count too.
"""

import ast
import graphlib
import pathlib
from collections.abc import Collection, Iterator, Mapping

import pytest

from tests.helpers.repository import REPOSITORY

# From the lowest up: a module may import its own layer and the layers before it.
LAYERS = (
    ("base",),
    ("control",),
    ("deploy",),
    ("runs",),
    ("arms",),
    ("metric",),
    ("physics",),
    ("motions",),
    ("retargeting",),
    ("envs",),
    ("evaluation",),
    ("viewer",),
    ("trainers",),
    ("commands",),
)  # and above these the modules directly in the package: the entry points, cli, gymnasium, __init__
DATA = ("conf",)  # packages for Hydra's sake, without code
# Imports that break the rule: {(module, module that it imports): reason}.
EXCEPTIONS: dict[tuple[str, str], str] = {}

Imports = Mapping[str, set[str]]


def imports_of(package: pathlib.Path) -> Imports:
    """The modules of a package that each of its modules imports, all by their full names."""
    files = {_name(path, package): path for path in package.rglob("*.py")}
    return {name: set(_imported(path, name, files)) for name, path in files.items()}


def _name(path: pathlib.Path, package: pathlib.Path) -> str:
    parts = path.relative_to(package.parent).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


def _imported(path: pathlib.Path, name: str, modules: Collection[str]) -> Iterator[str]:
    package = name.split(".") if path.stem == "__init__" else name.split(".")[:-1]
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names if alias.name in modules)
        elif isinstance(node, ast.ImportFrom):
            parents = package[: len(package) + 1 - node.level] if node.level else []
            source = ".".join([*parents, *filter(None, [node.module])])
            submodules = {f"{source}.{alias.name}" for alias in node.names}
            yield from submodules.intersection(modules)
            if source in modules and not submodules <= set(modules):  # a name that the package itself defines
                yield source


def upward_imports(imports: Imports) -> set[tuple[str, str]]:
    """Pairs (module, module that it imports) of which the second belongs to a higher layer."""
    level = {part: number for number, layer in enumerate(LAYERS) for part in layer}

    def level_of(module: str) -> int:
        return level.get(".".join(module.split(".")[1:2]), len(LAYERS))

    return {(name, used) for name in imports for used in imports[name] if level_of(used) > level_of(name)}


def circle(imports: Imports) -> list[str]:
    """Modules of a circular import, the first one repeated at the end; empty where there is none."""
    try:
        graphlib.TopologicalSorter(imports).prepare()
    except graphlib.CycleError as error:
        return error.args[1]
    return []


def test_imports_run_one_way():
    imports = imports_of(REPOSITORY / "mimic")
    assert len(imports) > 100  # it does look at the package
    assert upward_imports(imports) == set(EXCEPTIONS)
    assert circle({name: {used for used in imports[name] if (name, used) not in EXCEPTIONS} for name in imports}) == []


def test_each_folder_has_a_layer():
    folders = {path.parent.name for path in (REPOSITORY / "mimic").glob("*/__init__.py")} - set(DATA)
    layers = {name for layer in LAYERS for name in layer}
    assert folders <= layers
    assert all(
        (REPOSITORY / "mimic" / name).is_dir() or (REPOSITORY / "mimic" / f"{name}.py").is_file() for name in layers
    )


@pytest.mark.parametrize(
    ("file", "line", "found"),
    [
        ("arms/arm.py", "from mimic.metric.distance import distance", "mimic.metric.distance"),
        ("arms/arm.py", "from mimic.metric import distance", "mimic.metric.distance"),
        ("arms/arm.py", "from mimic.metric import of_the_package", "mimic.metric"),
        ("arms/arm.py", "import mimic.metric.distance", "mimic.metric.distance"),
        ("arms/arm.py", "from ..metric import distance", "mimic.metric.distance"),
        ("arms/arm.py", "from ..metric.distance import distance", "mimic.metric.distance"),
        ("arms/arm.py", "import mimic", "mimic"),
        ("arms/arm.py", "def late():\n    from mimic.metric import distance", "mimic.metric.distance"),
        ("arms/arm.py", "if TYPE_CHECKING:\n    from mimic.metric import distance", "mimic.metric.distance"),
        ("arms/__init__.py", "from ..metric import distance", "mimic.metric.distance"),
        ("commands/train.py", "from mimic.train import prepare", "mimic.train"),
    ],
)
def test_an_import_that_runs_up_is_found(tmp_path, file, line, found):
    imports = imports_of(_package(tmp_path, {file: line}))
    module = "mimic." + file.removesuffix(".py").removesuffix("/__init__").replace("/", ".")
    assert upward_imports(imports) == {(module, found)} and not circle(imports)


def test_a_circle_is_found(tmp_path):
    changes = {
        "distance": "from mimic.metric import states",
        "states": "def late():\n    from mimic.metric import distance",
    }
    imports = imports_of(_package(tmp_path, {f"metric/{name}.py": text for name, text in changes.items()}))
    first, *_, last = circle(imports)
    assert first == last and not upward_imports(imports)


def test_imports_that_run_down_pass(tmp_path):
    files = {
        "metric/distance.py": "import math\nfrom mimic.base import compat\nfrom ..arms.arm import arm\n"
        "from . import states",
        "commands/train.py": "def late():\n    from mimic.metric.distance import distance",
        "train.py": "from mimic import cli\nfrom mimic.commands.train import prepare",
    }
    imports = imports_of(_package(tmp_path, files))
    assert imports["mimic.metric.distance"] == {"mimic.base.compat", "mimic.arms.arm", "mimic.metric.states"}
    assert imports["mimic.train"] == {"mimic.cli", "mimic.commands.train"}
    assert not upward_imports(imports) and not circle(imports)


def _package(folder: pathlib.Path, changes: dict[str, str]) -> pathlib.Path:
    """A small package of that name, with some files changed."""
    names = [
        "base/compat",
        "base/config",
        "cli",
        "train",
        "arms/arm",
        "metric/distance",
        "metric/states",
        "commands/train",
    ]
    packages = ["__init__.py", *(f"{name}/__init__.py" for name in ("base", "arms", "metric", "commands"))]
    for name, text in {**dict.fromkeys([*packages, *(f"{name}.py" for name in names)], ""), **changes}.items():
        (folder / "mimic" / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / "mimic" / name).write_text(text)
    return folder / "mimic"
