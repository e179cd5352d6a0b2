"""`python -m benchmarks.models`: counts of a few files."""

import json

from benchmarks import models
from mimic.arms import model_files
from tests.helpers import original_model


def test_files_are_counted_by_cause(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(model_files, "check_in_process", lambda *_: [])
    arm, folder = original_model.urdf(), tmp_path / "arms"
    folder.mkdir()
    for name, text in {
        "arm": arm,
        "same": arm,
        "twice": arm.replace('name="j3"', 'name="j2"'),
        "thrice": arm.replace('name="j4"', 'name="j3"'),
        "text": "<robot",
        "plate": '<robot name="plate"><link name="plate"/></robot>',
    }.items():
        (folder / f"{name}.urdf").write_text(text)
    models.main([str(folder), "--out", str(tmp_path / "results.json")])
    assert "is rejected: two joints are called …" in capsys.readouterr().out
    results = json.loads((tmp_path / "results.json").read_text())
    assert (results["files"], results["arms"], results["loads"]) == (5, 3, 1)
    counts = {row["cause"]: row["count"] for row in results["causes"] if row["arm"]}
    assert counts == {"loads": 1, "… is rejected: two joints are called …; expected one name each": 2}
