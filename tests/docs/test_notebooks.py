"""The notebooks run from top to bottom, use what is public, and are stored without outputs."""

import ast
import json
import os

import pytest

import mimic
from tests.helpers.repository import CACHED, REPOSITORY

NOTEBOOKS = sorted((REPOSITORY / "examples" / "notebooks").glob("*.ipynb"))
SLOW = "2_train_and_evaluate", "4_other_arm"


def named(path):
    return path.stem


def code_cells(path):
    return [cell for cell in json.loads(path.read_text())["cells"] if cell["cell_type"] == "code"]


def test_there_are_four_notebooks_and_the_index_lists_them():
    index = (REPOSITORY / "examples" / "README.md").read_text()
    assert [path.stem[0] for path in NOTEBOOKS] == ["1", "2", "3", "4"]
    assert all(f"](notebooks/{path.name})" in index for path in NOTEBOOKS)


@pytest.mark.parametrize("path", NOTEBOOKS, ids=named)
def test_notebooks_are_stored_without_outputs(path):
    for cell in code_cells(path):
        assert cell["outputs"] == [] and cell["execution_count"] is None


@pytest.mark.parametrize("path", NOTEBOOKS, ids=named)
def test_notebooks_use_what_is_public(path):
    source = "\n".join("".join(cell["source"]) for cell in code_cells(path))
    tree = ast.parse(source)
    imported = [node for node in ast.walk(tree) if isinstance(node, ast.ImportFrom) and "mimic" in (node.module or "")]
    used = {
        node.attr
        for node in ast.walk(tree)
        if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name) and node.value.id == "mimic"
    }
    assert not imported and used <= set(mimic.__all__) and ("import mimic" in source or '"-m", "mimic"' in source)


@pytest.mark.slow_for("1_metric_and_retargeting", "3_own_arm")
@pytest.mark.timeout(900)
@pytest.mark.parametrize(
    "path", [pytest.param(path, marks=pytest.mark.slow if path.stem in SLOW else ()) for path in NOTEBOOKS], ids=named
)
def test_notebooks_run(path, tmp_path, monkeypatch):
    nbclient = pytest.importorskip("nbclient")
    pytest.importorskip("ipykernel")
    nbformat = pytest.importorskip("nbformat")
    for name, value in {**CACHED, "PYTHONPATH": str(REPOSITORY)}.items():
        monkeypatch.setenv(name, value)
    notebook = nbformat.read(path, as_version=4)
    nbformat.validate(notebook)
    resources = {"metadata": {"path": str(tmp_path)}}
    nbclient.NotebookClient(notebook, timeout=600, kernel_name="python3", resources=resources).execute()
    printed = [output for cell in notebook.cells for output in cell.get("outputs", ())]
    assert any(output["output_type"] in ("stream", "display_data", "execute_result") for output in printed)
    if os.environ.get("MIMIC_NOTEBOOKS"):  # a folder, to look at the notebooks with their outputs
        nbformat.write(notebook, os.path.join(os.environ["MIMIC_NOTEBOOKS"], path.name))
