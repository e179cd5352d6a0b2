"""Imports of the package run one way: a folder imports only from those below it, and there are no circular imports.

Imports within functions and imports for type checkers count too.
"""

import ast
import graphlib
import pathlib
from collections.abc import Collection, Iterator

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

Imports = dict[str, set[str]]


def imports_of(package: pathlib.Path) -> Imports:
    """The modules of a package that each of its modules imports, all by their full names."""
    files = {
        ".".join(path.relative_to(package.parent).with_suffix("").parts).removesuffix(".__init__"): path
        for path in package.rglob("*.py")
    }
    return {name: set(_imported(path, files)) for name, path in files.items()}


def _imported(path: pathlib.Path, modules: Collection[str]) -> Iterator[str]:
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names if alias.name in modules)
        elif isinstance(node, ast.ImportFrom):
            assert not node.level, f"{path}: expected absolute imports alone"
            submodules = {f"{node.module}.{alias.name}" for alias in node.names}
            yield from submodules.intersection(modules)
            if node.module in modules and not submodules <= set(modules):  # a name that the package itself defines
                yield str(node.module)


def upward_imports(imports: Imports) -> set[tuple[str, str]]:
    """Pairs (module, module that it imports) of which the second belongs to a higher layer."""
    level = {part: number for number, layer in enumerate(LAYERS) for part in layer}

    def level_of(module: str) -> int:
        return level.get(".".join(module.split(".")[1:2]), len(LAYERS))

    return {(name, used) for name in imports for used in imports[name] if level_of(used) > level_of(name)}


def test_imports_run_one_way():
    imports = imports_of(REPOSITORY / "mimic")
    assert len(imports) > 100  # it does look at the package
    assert not upward_imports(imports)
    graphlib.TopologicalSorter(imports).prepare()  # raises where they are circular


def test_each_folder_has_a_layer():
    folders = {path.parent.name for path in (REPOSITORY / "mimic").glob("*/__init__.py")} - set(DATA)
    assert folders == {name for layer in LAYERS for name in layer}


@pytest.mark.parametrize(
    ("line", "found"),
    [
        ("from mimic.metric.distance import distance", "mimic.metric.distance"),
        ("from mimic.metric import distance", "mimic.metric.distance"),
        ("from mimic.metric import of_the_package", "mimic.metric"),
        ("import mimic.metric.distance", "mimic.metric.distance"),
        ("def late():\n    import mimic", "mimic"),
    ],
)
def test_an_import_that_runs_up_is_found(tmp_path, line, found):
    for name in ("__init__", "arms/__init__", "arms/arm", "metric/__init__", "metric/distance"):
        path = tmp_path / "mimic" / f"{name}.py"
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(line if name == "arms/arm" else "")
    assert upward_imports(imports_of(tmp_path / "mimic")) == {("mimic.arms.arm", found)}
