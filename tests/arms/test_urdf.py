"""URDF files as people have them: unphysical inertia, shapes without a size, limits that are none, templates."""

import struct
from xml.etree import ElementTree

import numpy as np
import pytest

import mimic
from mimic.arms import model_files
from mimic.arms.model_files import read_model
from mimic.arms.urdf import mend_urdf
from tests.helpers import original_model

INERTIA = 'ixx="0.02" iyy="0.02" izz="0.01"'  # of the links of the generated arm


@pytest.fixture
def read(tmp_path, monkeypatch):
    """A function that reads a generated URDF after replacements; as the last one, parts to add to it."""
    monkeypatch.setattr(model_files, "check_in_process", lambda *_: [])

    def read(*replacements, parts=""):
        text = original_model.urdf().replace("</robot>", f"{parts}</robot>")
        for old, new in replacements:
            assert old in text
            text = text.replace(old, new, 1)
        (tmp_path / "arm.urdf").write_text(text)
        return mimic.load_mjcf(tmp_path / "arm.urdf"), read_model(tmp_path / "arm.urdf")

    return read


def inertial(mass, *moments):
    names = "ixx", "iyy", "izz", "ixy", "ixz", "iyz"
    values = " ".join(f'{name}="{value!r}"' for name, value in zip(names, moments, strict=False))
    return f'<inertial><mass value="{mass}"/><inertia {values}/></inertial>'


def fixed(link, content=""):
    return (
        f'<link name="{link}">{content}</link><joint name="{link}_fix" type="fixed"><parent link="base"/>'
        f'<child link="{link}"/></joint>'
    )


# --- inertia ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("mass", "moments", "expected"),
    [
        (1.0, (0.01, 0.01, 0.5), (0.5, 0.25, 0.25)),  # a disc: the moment that is too large stays
        (1.0, (0.1, 0.3, 0.5), (0.5, 0.35, 0.15)),  # a' = (a + c - b) / 2, b' = (b + c - a) / 2
        (0.0, (0.1, 0.1, 0.1), (0, 0, 0)),
        (-1.0, (0.1, 0.1, 0.1), (0, 0, 0)),
        ("nan", (0.1, 0.1, 0.1), (0, 0, 0)),
        (1e7, (0.1, 0.1, 0.1), (0, 0, 0)),
        (3.0, (float("nan"), 0.1, 0.1), (2e-6, 2e-6, 2e-6)),  # a ball whose radius of gyration is 1 mm
        (2.0, (0.2, 0.2, 0.2), (0.2, 0.2, 0.2)),
    ],
)
def test_an_unphysical_inertia_becomes_the_nearest_physical_one(read, mass, moments, expected):
    plain, _ = read()
    arm, model = read(parts=fixed("sensor", inertial(mass, *moments)))
    np.testing.assert_allclose(np.sort(model.body("sensor").inertia), np.sort(expected), atol=1e-5)
    np.testing.assert_array_equal(arm.joint_anchor, plain.joint_anchor)
    np.testing.assert_array_equal(arm.link_position, plain.link_position)


def test_the_corrected_inertia_is_nearer_than_any_other_body():
    """P projects onto a convex cone: (x - P) . (y - P) <= 0 for each y of the cone, here second moments of mass."""
    rng = np.random.default_rng(0)
    for _ in range(20):
        matrix = rng.normal(size=(3, 3))
        moments = matrix + matrix.T
        entries = moments[[0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]].tolist()
        root = ElementTree.fromstring(f'<robot name="r"><link name="a">{inertial(1.0, *entries)}</link></robot>')
        mend_urdf(root)
        found = {name: float(value) for name, value in next(root.iter("inertia")).attrib.items()}
        corrected = np.array([[found["i" + "".join(sorted(row + column))] for column in "xyz"] for row in "xyz"])
        before, after = (np.trace(x) / 2 * np.eye(3) - x for x in (moments, corrected))
        assert np.linalg.eigvalsh(after)[0] > 0
        if np.linalg.eigvalsh(before)[-1] < 0:
            continue  # no body is near
        for _ in range(20):
            other = rng.normal(size=(3, 3))
            assert np.sum((before - after) * (other @ other.T - after)) < 1e-4  # the corrected one is thick by 1e-6


def test_each_change_is_a_line_that_names_it(read, caplog):
    read(
        (INERTIA, 'ixx="0.02" iyy="0.02" izz="0.05"'),
        ('lower="-2.5" upper="2.5" effort="38"', 'lower="1" upper="-1" effort="38"'),
        ('lower="-2.5" upper="2.5" effort="37"', 'lower="0" upper="0" effort="37"'),
        ('lower="-2.5" upper="2.5" effort="36"', 'lower="-1" effort="36"'),
        ('lower="-2.5" upper="2.5" effort="39"', 'lower="-170" upper="170" effort="39"'),
    )
    for line in (
        "corrected the inertia of l1, which no body has, to the nearest physical one",
        "lower limit above the upper one in j2: swapped",
        "no range of angles in j3: a full turn is assumed",
        "one limit alone is stated in j4: 0 is the other one",
        "limits beyond 50 in j1: read as rad, as URDF defines them, and not as degrees",
    ):
        assert line in caplog.text, caplog.text
    assert "equal lower and upper" not in caplog.text  # MuJoCo's warning


def test_an_arm_without_any_inertia_has_its_kinematics(read, caplog, tmp_path):
    plain, _ = read()
    text = original_model.urdf()
    while "<inertial>" in text:
        text = text[: text.index("<inertial>")] + text[text.index("</inertial>") + len("</inertial>") :]
    (tmp_path / "bare.urdf").write_text(text)
    arm = mimic.load_mjcf(tmp_path / "bare.urdf")
    np.testing.assert_array_equal(arm.link_position, plain.link_position)
    assert "no <inertial> with a mass in l1, l2, l3, l4: a ball of 1 kg" in caplog.text
    model = read_model(tmp_path / "bare.urdf")
    assert model.body("l2").mass == 1 and model.body("l2").inertia == pytest.approx(0.4 * 0.1**2)


def test_a_light_link_between_others_is_not_heavy(read):
    _, model = read((f'<mass value="2"/>\n            <inertia {INERTIA} ixy="0" ixz="0" iyz="0"/>', ""))
    assert model.body("l1").mass == 1e-3 and model.body("l2").mass == 2


# --- shapes -----------------------------------------------------------------------------------------------------------

POINTER = "version https://git-lfs.github.com/spec/v1\noid sha256:0\nsize 12345\n"
FLAT = b" " * 80 + struct.pack("<I", 2) + struct.pack("<12fH", 0, 0, 1, 0, 0, 0, 1, 0, 0, 0, 1, 0, 0) * 2


def shape(geometry):
    return f"<collision><geometry>{geometry}</geometry></collision>"


NOTHING = [
    "",
    "<plane/>",
    "<box/>",
    '<box size="0 0 0"/>',
    '<box size="-1 1 1"/>',
    '<sphere radius="0"/>',
    '<cylinder radius="1" length="0"/>',
]


@pytest.mark.parametrize("geometry", NOTHING)
def test_shapes_without_a_size_are_left_out(read, caplog, geometry):
    assert read(parts=fixed("tag", shape(geometry)))[1].ngeom == 0
    assert "ignored the shapes without a size of tag" in caplog.text


@pytest.mark.parametrize("content", [POINTER.encode(), FLAT], ids=["a pointer of Git LFS", "flat"])
def test_meshes_that_mujoco_cannot_use_are_left_out(tmp_path, caplog, content):
    (tmp_path / "tag.stl").write_bytes(content)
    file = tmp_path / "arm.urdf"
    file.write_text(
        original_model.urdf().replace("</robot>", fixed("tag", shape('<mesh filename="tag.stl"/>')) + "</robot>")
    )
    assert mimic.load_mjcf(file).num_joints == 4
    assert "ignored 1 meshes that cannot be read, the first tag.stl" in caplog.text


# --- limits -----------------------------------------------------------------------------------------------------------

LIMITS = 'lower="-2.5" upper="2.5" effort="39" velocity="0.5"'


@pytest.mark.parametrize(
    ("limits", "expected"),
    [
        (LIMITS, (-2.5, 2.5, 39, 0.5)),
        ('lower="2" upper="-1" effort="39" velocity="-1"', (-1, 2, 39, np.inf)),
        ('lower="0" upper="0" effort="0" velocity="0"', (-np.pi, np.pi, np.inf, np.inf)),
        ('lower="-1e16" upper="1e16" effort="-1" velocity="1e30"', (-np.pi, np.pi, np.inf, np.inf)),
        ('upper="1.5" effort="inf" velocity="inf"', (0, 1.5, np.inf, np.inf)),
        ('lower="1.5" effort="39" velocity="0.5"', (0, 1.5, 39, 0.5)),
        ('effort="39" velocity="0.5"', (-np.pi, np.pi, 39, 0.5)),
    ],
)
def test_limits_of_a_joint(read, limits, expected):
    arm, _ = read((LIMITS, limits))
    found = (*arm.joint_range[0], arm.torque_limit[0], arm.velocity_limit[0])
    assert found == pytest.approx(expected)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ('name="j3"', 'name="j2"', "two joints are called 'j2'; expected one name each$"),
        ('name="l3"', 'name="l2"', "two links are called 'l2'; expected one name each$"),
        ('velocity="0.5"', 'velocity="fast"', "the velocity limit of joint 'j1': expected a number, got 'fast'$"),
        ('upper="2.5"', 'upper="pi"', "the upper limit of joint 'j1': expected a number, got 'pi'$"),
        (INERTIA, 'ixx="heavy"', "the inertia of link 'l1': expected a number, got 'heavy'$"),
    ],
)
def test_errors_name_the_link_or_joint(read, old, new, message):
    with pytest.raises(ValueError, match=f"^'.*arm.urdf' is rejected: {message}"):
        read((old, new))


@pytest.mark.parametrize(
    "text",
    [
        '<robot xmlns:xacro="http://www.ros.org/wiki/xacro"><xacro:include filename="a.xacro"/><xacro:arm/></robot>',
        '<robot><xacro:arm prefix=""/></robot>',
        '<robot><link name="a"/><joint name="j" type="fixed"><origin xyz="0 0 ${h}"/></joint></robot>',
    ],
)
def test_a_template_gets_a_line_that_says_how_to_expand_it(tmp_path, text):
    (tmp_path / "arm.urdf").write_text(text)
    with pytest.raises(ValueError, match="is a xacro, a template of a URDF; expand it first, with `xacro FILE"):
        mimic.load_mjcf(tmp_path / "arm.urdf")


def test_a_namespace_of_all_elements_is_no_obstacle(read):
    arm, _ = read(('<robot name="four"', "<robot xmlns='http://drake.mit.edu' name=\"four\""))
    assert arm.num_joints == 4


def test_an_expanded_file_may_keep_calls_of_macros(read):
    names = 'xmlns:xacro="http://www.ros.org/wiki/xacro"'
    arm, _ = read(('<robot name="four"', f'<robot {names} name="four"'), parts="<gazebo><xacro:grey/></gazebo>")
    assert arm.num_joints == 4
