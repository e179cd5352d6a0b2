"""The start pose of an arm: a list, a mapping, a keyframe; locked joints are locked there."""

import numpy as np
import pytest

import mimic
from mimic.arms.arm import ArmConfig, build_arm

ARM = """<mujoco model="toy">
  <worldbody>
    <body><joint name="a" axis="0 0 1" range="-90 90"/><geom size="0.1" mass="1"/>
      <body pos="0 0 0.3"><joint name="b" axis="0 1 0" range="-90 90"/><geom size="0.1" mass="1"/>
        <body pos="0 0 0.3"><joint name="c" axis="0 1 0" range="10 90"/><geom size="0.1" mass="1"/>
          <site name="end" pos="0 0 0.3"/>
        </body>
      </body>
    </body>
  </worldbody>
  <keyframe><key name="home" qpos="0 0.1 0.4"/><key name="bent" qpos="0.2 0.5 1"/></keyframe>
</mujoco>
"""


@pytest.fixture(scope="module")
def file(tmp_path_factory):
    path = tmp_path_factory.mktemp("arm") / "toy.xml"
    path.write_text(ARM)
    return str(path)


@pytest.mark.parametrize(
    ("home", "limits", "expected"),
    [
        (None, "none", [0, 0, 0]),
        (None, "hardware", [0, 0.1, 0.4]),
        ([0.3, 0, -0.2], "none", [0.3, 0, -0.2]),
        ([0.3, 0, 0.2], "hardware", [0.3, 0, 0.2]),
        ({"b": 0.7}, "none", [0, 0.7, 0]),
        ({2: 0.7}, "hardware", [0, 0.7, 0.4]),
        ("bent", "none", [0.2, 0.5, 1]),
        ("home", "none", [0, 0.1, 0.4]),
    ],
)
def test_start_poses(home, limits, expected, file):
    arm = build_arm(ArmConfig(model=file, home=home), limits)
    np.testing.assert_allclose(arm.embodiment.home, expected)


def test_joints_are_locked_at_the_start_pose(file):
    arm = build_arm(ArmConfig(model=file, home=[0.3, 0.6, 0.2], locked=["b"]))
    assert arm.locked == {"b": 0.6} and arm.embodiment.home.tolist() == [0.3, 0.2]
    assert build_arm(ArmConfig(model=file, home="bent", locked={"b": 0})).locked == {"b": 0}


def test_own_arms_and_environments_take_a_start_pose():
    config = mimic.env_config("planar4dof", learner={"home": [0.1, 0.2, 0.3, 0.4]})
    assert config.build_arms().learner.embodiment.home.tolist() == [0.1, 0.2, 0.3, 0.4]
    ready = build_arm(ArmConfig(home="ready")).embodiment.home
    np.testing.assert_allclose(ready, build_arm(ArmConfig(), "hardware").embodiment.home)


@pytest.mark.parametrize(
    ("home", "limits", "message"),
    [
        ([0, 1], "none", r"home: expected 3 angles \[rad\], one for each of a, b, c, a mapping .* got \[0, 1\]"),
        (3, "none", "home: expected 3 angles"),
        ([], "none", "home: expected 3 angles"),
        ("bnt", "none", r"home: unknown keyframe 'bnt'; valid are home, bent; did you mean bent\?"),
        ({"d": 0}, "none", "home: unknown joint 'd'; valid are a, b, c or 1 to 3"),
        ([0, 0, 4], "none", "home: c: expected an angle from -3.142 to 3.142 rad, got 4"),
        ([0, 0, 0], "hardware", "home: c: expected an angle from 0.1745 to 1.571 rad, got 0"),
        ([0, 0, float("nan")], "none", "home: c: expected an angle .* got nan"),
        (["x", 0, 0], "none", "home: a: expected an angle .* got 'x'"),
        ([True, 0, 0], "none", "home: a: expected an angle .* got True"),
    ],
)
def test_bad_start_poses(home, limits, message, file):
    with pytest.raises(ValueError, match=message):
        build_arm(ArmConfig(model=file, home=home), limits)
