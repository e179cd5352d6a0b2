"""`python -m benchmarks.hands`: the hands of two arms, and a file that is none."""

import json

from PIL import Image

from benchmarks import hands
from mimic.arms.embodiment import panda_path


def test_hands_in_a_table_and_a_picture(tmp_path):
    files = [f"Arm={panda_path()}", f"{panda_path('panda_pair')}@left_tcp", f"None={tmp_path / 'none.urdf'}"]
    hands.main([*files, "--out", str(tmp_path / "hands.json"), "--picture", str(tmp_path / "hands.png")])
    named, pair, failed = json.loads((tmp_path / "hands.json").read_text())["hands"]
    assert (named["arm"], pair["arm"]) == ("Arm", "panda_pair")
    assert named["approach"] == pair["approach"] == [0, 0, -1]
    assert "as tip= says" in pair["reason"] and "none.urdf" in failed["failed"]
    assert Image.open(tmp_path / "hands.png").width > 1000
