"""Arms by name: from a folder that a variable names, a package, or a cache; all made here, of a small model."""

import pytest

import mimic
from mimic.arms.arm import ArmConfig, build_arm
from mimic.arms.named_arms import MENAGERIE, named_arms
from tests.arms.test_start_pose import ARM


@pytest.fixture
def places(tmp_path, monkeypatch):
    """Empty places, in which a function writes the model of an arm."""
    package, clone, cache = tmp_path / "packages" / "robosuite", tmp_path / "clone", tmp_path / "cache"
    package.mkdir(parents=True)
    (package / "__init__.py").write_text("raise ImportError('it must not be imported')\n")
    monkeypatch.syspath_prepend(package.parent)
    monkeypatch.setenv(MENAGERIE, str(clone))
    monkeypatch.setenv("ROBOT_DESCRIPTIONS_CACHE", str(cache))
    work = tmp_path / "work"
    work.mkdir()
    monkeypatch.chdir(work)
    files = {
        "menagerie": lambda name: clone / f"maker_{name}" / f"{name}.xml",
        "robosuite": lambda name: package / "models/assets/robots" / name / "robot.xml",
        "cache": lambda name: cache / "mujoco_menagerie" / f"maker_{name}" / f"{name}.xml",
        "commit": lambda name: cache / "mujoco_menagerie-1234" / "mujoco_menagerie" / f"maker_{name}" / f"{name}.xml",
    }

    def write(place, name):
        file = files[place](name)
        file.parent.mkdir(parents=True)
        file.write_text(ARM)
        (file.parent / "scene.xml").write_text("<mujoco/>")
        return file

    return write


@pytest.mark.parametrize("place", ["menagerie", "robosuite", "cache", "commit"])
def test_each_place_has_arms_by_name(place, places):
    file = places(place, "toy7")
    assert named_arms() == {"toy7": file}
    config = mimic.env_config("pair", learner="toy7").learner
    assert config.model == str(file)
    assert build_arm(config).embodiment.joint_names == ("a", "b", "c")


def test_the_first_place_is_used(places):
    files = [places(place, "toy7") for place in ("menagerie", "robosuite", "cache")]
    assert ArmConfig(model="toy7").model == str(files[0])


def test_a_file_in_the_folder_is_preferred(places, tmp_path):
    places("robosuite", "toy7")
    file = tmp_path / "work" / "toy7"
    file.write_text(ARM)
    assert ArmConfig(model="toy7").model == str(file)


def test_our_own_arms_keep_their_names(places):
    places("robosuite", "panda")
    assert ArmConfig(model="panda").model == "panda" and not named_arms()


def test_an_arm_that_is_not_here_names_the_three_ways(places, reason):
    message = reason("inspect", "toy8")
    for way in ("the package robosuite", "robot_descriptions", "MUJOCO_MENAGERIE", "here are none"):
        assert way in message
    places("robosuite", "toy7")
    with pytest.raises(ValueError, match=r"got 'toy8'; .* here are toy7; did you mean toy7\?"):
        ArmConfig(model="toy8")
