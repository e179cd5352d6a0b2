"""Files of descriptions of arms."""

import numpy as np
import pytest

from mimic.arms.arm import ArmConfig, build_arm
from mimic.arms.arrays import arm_arrays
from mimic.arms.description import description, save_description


def test_an_npz_file_is_complete_or_not_there(tmp_path, monkeypatch):
    arm, file = arm_arrays(build_arm(ArmConfig())), tmp_path / "panda.npz"

    def fail(opened, **_):
        opened.write(b"PK")
        raise OSError("No space left on device")

    with monkeypatch.context() as patched:
        patched.setattr(np, "savez", fail)
        with pytest.raises(OSError, match="No space"):
            save_description(file, arm, "panda", ("joint1",))
    assert not file.exists()
    save_description(file, arm, "panda", ("joint1",))
    np.testing.assert_array_equal(np.load(file)["learner"], description(arm))
    assert list(tmp_path.iterdir()) == [file]
