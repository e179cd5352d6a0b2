"""Readers of motion capture: the generated person comes back from each format, unit and axis convention."""

import numpy as np
import pytest

from mimic.motions.mocap.arms import find_arms
from mimic.motions.mocap.conventions import UNITS, UPS, z_up
from mimic.motions.mocap.reading import read_motion
from tests.helpers.bodies import RATE, bvh_text, person

SAMPLES = 80
ARM = ("LeftArm", "LeftForeArm", "LeftHand", "LeftHandMiddle1")


@pytest.fixture(scope="module")
def expected():
    return person(SAMPLES)


def _bvh(tmp_path, text, name="clip.bvh"):
    path = tmp_path / name
    path.write_text(text)
    return path


def _assert_person(motion, expected):
    for name in expected.names:
        np.testing.assert_allclose(motion.point(name), expected.point(name), atol=1e-6)
    assert motion.rate == pytest.approx(RATE, rel=1e-6)


@pytest.mark.parametrize("unit", ["m", "cm", "cmu"])
def test_bvh_in_each_unit(tmp_path, expected, unit):
    motion = read_motion(_bvh(tmp_path, bvh_text(SAMPLES, unit=UNITS[unit])))
    _assert_person(motion, expected)
    assert f"unit: {unit}, found from the length of the arms" in motion.notes
    assert "up: y, from the feet to the head" in motion.notes


def test_angles_that_jump_by_a_full_turn_change_nothing(tmp_path, expected):
    _assert_person(read_motion(_bvh(tmp_path, bvh_text(SAMPLES, turns=True))), expected)


def test_a_wrong_number_of_frames_is_noted(tmp_path, expected):
    motion = read_motion(_bvh(tmp_path, bvh_text(SAMPLES, frames=SAMPLES - 1)))
    _assert_person(motion, expected)
    assert f"the header states {SAMPLES - 1} frames, the file has {SAMPLES}" in motion.notes


def test_braces_on_the_line_of_a_name_and_names_with_spaces(tmp_path):
    text = (
        bvh_text(SAMPLES).replace("\n{", " {").replace("ROOT Hips", "ROOT mixamorig:Hips of Bob").replace("\n", "\r\n")
    )
    motion = read_motion(_bvh(tmp_path, text))
    assert motion.names[0] == "mixamorig:Hips of Bob"
    np.testing.assert_allclose(motion.positions, read_motion(_bvh(tmp_path, bvh_text(SAMPLES))).positions)


@pytest.mark.parametrize("up", UPS)
def test_each_axis_can_be_up(up):
    turned = z_up(np.eye(3), up)  # rows are the images of x, y, z
    assert np.linalg.det(turned) == pytest.approx(1)
    sign = -1 if up.startswith("-") else 1
    np.testing.assert_array_equal(turned["xyz".index(up[-1])] * sign, [0, 0, 1])


@pytest.mark.parametrize("up", UPS)
def test_up_is_found_from_the_body(tmp_path, expected, up):
    rotated = expected.positions @ z_up(np.eye(3), up).T  # undoes z_up
    np.savez(tmp_path / "p.npz", names=np.array(expected.names), positions=rotated, rate=RATE)
    motion = read_motion(tmp_path / "p.npz")
    assert f"up: {up}, from the feet to the head" in motion.notes
    np.testing.assert_allclose(motion.positions, expected.positions, atol=1e-9)


def test_csv(tmp_path, expected):
    header = ",".join(["time", *(f"{name}_{axis}" for name in expected.names for axis in "xyz")])
    rows = np.concatenate([np.arange(SAMPLES)[:, None] / RATE, expected.positions.reshape(SAMPLES, -1)], axis=1)
    path = tmp_path / "clip.csv"
    np.savetxt(path, rows, delimiter=",", header=header, comments="")
    _assert_person(read_motion(path), expected)
    assert set(find_arms(read_motion(path))) == {"left", "right"}  # without parents, by the names alone


def test_trc(tmp_path, expected):
    names = ("LSHO", "LELB", "LWRA", "LWRB", "LFIN")
    wrist = expected.point("LeftHand")
    tracks = [
        expected.point("LeftArm"),
        expected.point("LeftForeArm"),
        wrist + 0.02,
        wrist - 0.02,
        expected.point(ARM[3]),
    ]
    values = np.stack(tracks, axis=1)[..., [1, 2, 0]] * 1000  # y up, mm
    lines = [
        "PathFileType\t4\t(X/Y/Z)\tclip.trc",
        "DataRate\tCameraRate\tNumFrames\tNumMarkers\tUnits\tOrigDataRate\tOrigDataStartFrame\tOrigNumFrames",
        f"{RATE}\t{RATE}\t{SAMPLES}\t{len(names)}\tmm\t{RATE}\t1\t{SAMPLES}",
        "Frame#\tTime\t" + "\t\t\t".join(names) + "\t\t",
        "\t\t" + "\t".join(f"X{i}\tY{i}\tZ{i}" for i in range(1, 6)),
    ]
    for sample, row in enumerate(values.reshape(SAMPLES, -1)):
        cells = [f"{value:.6f}" for value in row]
        if sample == 3:
            cells[:3] = ["", "", ""]  # a marker that was not seen
        lines.append("\t".join([str(sample + 1), f"{sample / RATE:.7f}", *cells]))
    path = tmp_path / "clip.trc"
    path.write_text("\n".join(lines))
    motion = read_motion(path)
    assert np.isnan(motion.positions[3, 0]).all() and np.isfinite(motion.positions[3, 1:]).all()
    np.testing.assert_allclose(motion.point("LELB"), expected.point("LeftForeArm"), atol=1e-6)
    arm = find_arms(motion)["left"]
    assert (arm.shoulder, arm.elbow, arm.wrist, arm.hand) == (("LSHO",), ("LELB",), ("LWRA", "LWRB"), ("LFIN",))


@pytest.mark.parametrize(
    ("unit", "message"),
    [
        ("m", None),
        ("mm", "unit: the file states mm, in which its arms have lengths of 0.00053, 0.00053 m; expected 0.3 to 0.9 m"),
        ("inch", "unit: the file states inch"),
        ("parsec", None),  # unknown: found from the arms
    ],
)
def test_a_stated_unit_is_checked(tmp_path, expected, unit, message):
    path = tmp_path / "p.npz"
    np.savez(path, names=np.array(expected.names), positions=expected.positions, rate=RATE, unit=np.array(unit))
    if message is None:
        return _assert_person(read_motion(path), expected)
    with pytest.raises(ValueError, match=message):
        read_motion(path)
    scaled = read_motion(path, unit=unit)  # the user's word counts
    np.testing.assert_allclose(scaled.positions, expected.positions * UNITS[unit], atol=1e-9)


def test_a_length_of_two_units_is_not_guessed(tmp_path, expected):
    """Arms of 7.2 are those of an adult in decimetres and in the unit of CMU's files."""
    path = _bvh(tmp_path, bvh_text(SAMPLES, unit=0.53 / 7.2))
    with pytest.raises(ValueError, match="its arms have lengths of 7.2, 7.2, as an adult's in dm and in cmu"):
        read_motion(path)
    assert read_motion(path, unit="cmu").rate == pytest.approx(RATE)


def test_uneven_times_are_resampled(tmp_path, expected):
    time = np.arange(SAMPLES) / RATE
    keep = np.delete(np.arange(SAMPLES), [20])
    np.savez(tmp_path / "p.npz", names=np.array(expected.names), positions=expected.positions[keep], time=time[keep])
    motion = read_motion(tmp_path / "p.npz")
    assert len(motion.positions) == SAMPLES and np.isnan(motion.positions[20]).all()
    known = np.isfinite(motion.positions).all(axis=(1, 2))
    assert known.sum() >= SAMPLES - 2
    np.testing.assert_allclose(motion.positions[known], expected.positions[known], atol=1e-6)
    assert any("resampled" in note for note in motion.notes)


@pytest.mark.parametrize(
    ("prefix", "names"),
    [
        ("", ("l_shoulder", "l_elbow", "l_wrist", "l_middle1")),
        ("", ("left_shoulder", "left_elbow", "left_wrist", "left_index")),
        ("", ("LeftUpperArm", "LeftForeArm", "LeftHand", "LeftHandIndex1")),
        ("Bip01 ", ("L UpperArm", "L Forearm", "L Hand", "L Finger1")),
        ("mixamorig:", ("LeftArm", "LeftForeArm", "LeftHand", "LeftHandMiddle1")),
        ("", ("lShldr", "lForeArm", "lHand", "lMid1")),
        ("", ("lhumerus", "lradius", "lhand", "lfingers")),
        ("", ("upper_arm.L", "forearm.L", "hand.L", "palm.L")),
    ],
)
def test_arms_are_found_by_the_names_of_many_tools(expected, prefix, names):
    chain = ["Hips", *(f"{prefix}{name}" for name in names)]
    positions = np.stack([expected.point("Hips"), *(expected.point(name) for name in ARM)], axis=1)
    motion = type(expected)(tuple(chain), (-1, 0, 1, 2, 3), positions, RATE)
    arm = find_arms(motion)["left"]
    assert [arm.shoulder, arm.elbow, arm.wrist, arm.hand] == [(name,) for name in chain[1:]]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda text: text.replace("MOTION", "", 1), "it has no MOTION section"),
        (lambda text: text.replace("}", "", 1), "closing brace"),
        (lambda text: text.replace("CHANNELS 3", "CHANNELS 4", 1), "CHANNELS: expected a number"),
        (lambda text: text.replace("Frame Time: 0", "Frame Time: -0"), "Frame Time: expected seconds"),
        (lambda text: text + " 1.0", "expected a multiple of"),
        (lambda text: text.replace("ROOT", "RUTE"), "expected ROOT"),
        (lambda text: text.replace("Left", "A").replace("Right", "B"), "unit: expected one of"),
    ],
)
def test_a_damaged_bvh_is_one_line(tmp_path, change, message):
    path = _bvh(tmp_path, change(bvh_text(5)))
    with pytest.raises(ValueError, match=message) as raised:
        read_motion(path)
    assert "\n" not in str(raised.value) and str(path) in str(raised.value)


def test_arguments_are_checked(tmp_path):
    with pytest.raises(ValueError, match="no file at"):
        read_motion(tmp_path / "none.bvh")
    with pytest.raises(ValueError, match="a file that ends in"):
        read_motion(_bvh(tmp_path, "", "clip.fbx"))
    with pytest.raises(ValueError, match="unit: .*mile"):
        read_motion(_bvh(tmp_path, bvh_text(5)), unit="mile")


def test_c3d(tmp_path, expected):
    ezc3d = pytest.importorskip("ezc3d", reason="the extra [mocap] is not installed")
    names = ["LSHO", "LELB", "LWRA", "LFIN"]
    tracks = np.stack([expected.point(name) for name in ARM], axis=1)
    points = np.ones((4, len(names), SAMPLES))
    points[:3] = np.moveaxis(tracks, -1, 0).swapaxes(1, 2) * 1000
    points[:, 1, 5] = np.nan
    file = ezc3d.c3d()
    file["parameters"]["POINT"]["RATE"]["value"] = [RATE]
    file["parameters"]["POINT"]["LABELS"]["value"] = names
    file["parameters"]["POINT"]["UNITS"]["value"] = ["mm"]
    file["data"]["points"] = points
    file.write(str(tmp_path / "clip.c3d"))
    motion = read_motion(tmp_path / "clip.c3d")
    assert motion.names == tuple(names) and motion.rate == RATE
    assert np.isnan(motion.positions[5, 1]).all()
    known = np.arange(SAMPLES) != 5
    np.testing.assert_allclose(motion.positions[known], tracks[known], atol=1e-6)


def test_a_damaged_c3d_cannot_end_the_process(tmp_path):
    """ezc3d itself crashes on some of these."""
    pytest.importorskip("ezc3d", reason="the extra [mocap] is not installed")
    for content in (b"\x02P" + bytes(600), b"\x02P\x01\x00\xff\xff" * 200):
        (tmp_path / "bad.c3d").write_bytes(content)
        with pytest.raises(ValueError, match="bad.c3d.*ezc3d cannot read it"):
            read_motion(tmp_path / "bad.c3d")
