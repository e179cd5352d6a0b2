"""Readers of motion capture: the generated person comes back from each format, unit and axis convention."""

import dataclasses

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mimic.motions.mocap.arms import find_arms
from mimic.motions.mocap.conventions import UNITS, UPS, z_up
from mimic.motions.mocap.points import ArmPoints, PointMotion
from mimic.motions.mocap.reading import read_motion
from tests.helpers.bodies import RATE, bvh_text, person, write_c3d, write_npz, write_trc

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


def _other_layout(text):
    """Braces on the line of a name, and another ending of lines."""
    return text.replace("\n{", " {").replace("\n", "\r\n")


FRAMES = f"the header states {SAMPLES - 1} frames, the file has {SAMPLES}"


@pytest.mark.parametrize(
    ("text", "note"),
    [
        *((bvh_text(SAMPLES, unit=UNITS[unit]), f"unit: {unit}, found from the length of the arms")
          for unit in ("m", "cm", "cmu")),
        (bvh_text(SAMPLES, turns=True), "up: y, from the feet to the head"),  # angles that jump by a full turn
        (bvh_text(SAMPLES, frames=SAMPLES - 1), FRAMES),
        (_other_layout(bvh_text(SAMPLES)), "up: y, from the feet to the head"),
    ],
    ids=["m", "cm", "cmu", "turns", "frames", "layout"],
)  # fmt: skip
def test_bvh(tmp_path, expected, text, note):
    motion = read_motion(_bvh(tmp_path, text))
    _assert_person(motion, expected)
    assert note in motion.notes


def test_names_with_spaces(tmp_path):
    text = bvh_text(5).replace("ROOT Hips", "ROOT mixamorig:Hips of Bob")
    assert read_motion(_bvh(tmp_path, text)).names[0] == "mixamorig:Hips of Bob"


@pytest.mark.parametrize("up", UPS)
def test_up_is_found_from_the_body(tmp_path, expected, up):
    turned = z_up(np.eye(3), up)  # rows are the images of x, y, z
    assert np.linalg.det(turned) == pytest.approx(1)
    sign = -1 if up.startswith("-") else 1
    np.testing.assert_array_equal(turned["xyz".index(up[-1])] * sign, [0, 0, 1])
    motion = read_motion(write_npz(tmp_path / "p.npz", expected.names, expected.positions @ turned.T))  # undoes z_up
    guess = "" if up in ("y", "z", "-y") else ": a guess, capture.up= sets it"
    assert f"up: {up}, from the feet to the head{guess}" in motion.notes
    np.testing.assert_allclose(motion.positions, expected.positions, atol=1e-9)


def test_csv(tmp_path, expected):
    """A cell without a number is a point that was not seen."""
    header = ["Time (s)", *(f"{name}_{axis}" for name in expected.names for axis in "xyz")]
    values = np.concatenate([np.arange(SAMPLES)[:, None] / RATE, expected.positions.reshape(SAMPLES, -1)], axis=1)
    rows = [header, *(list(map(str, row)) for row in values)]
    rows[8][1:4] = "---"
    (tmp_path / "clip.csv").write_text("\n".join(map(";".join, rows)))
    motion, seen = read_motion(tmp_path / "clip.csv"), expected.positions.copy()
    seen[7, 0] = np.nan
    _assert_person(motion, dataclasses.replace(expected, positions=seen))
    assert set(find_arms(motion)) == {"left", "right"}  # without parents, by the names alone


def test_trc(tmp_path, expected):
    names = ("LSHO", "LELB", "LWRA", "LWRB", "LFIN")
    wrist = expected.point("LeftHand")
    tracks = [expected.point(ARM[0]), expected.point(ARM[1]), wrist + 0.02, wrist - 0.02, expected.point(ARM[3])]
    written = PointMotion(names, (-1,) * 5, np.stack(tracks, axis=1), RATE)
    written.positions[3, 0] = np.nan
    motion = read_motion(write_trc(tmp_path / "clip.trc", written, separator=","))
    np.testing.assert_allclose(motion.positions, written.positions, atol=1e-6)
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
    path = write_npz(tmp_path / "p.npz", expected.names, expected.positions, unit=np.array(unit))
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
    motion = read_motion(write_npz(tmp_path / "p.npz", expected.names, expected.positions[keep], time=time[keep]))
    assert len(motion.positions) == SAMPLES and np.isnan(motion.positions[20]).all()
    known = np.isfinite(motion.positions).all(axis=(1, 2))
    assert known.sum() >= SAMPLES - 2
    np.testing.assert_allclose(motion.positions[known], expected.positions[known], atol=1e-6)
    assert any("resampled" in note for note in motion.notes)


def test_a_trc_file_that_is_cut_off_is_a_note(tmp_path, expected):
    path = write_trc(tmp_path / "clip.trc", _markers(expected, MARKERS))
    path.write_text("\n".join(path.read_text().splitlines()[:-10]))
    assert f"the header states {SAMPLES} frames, the file has {SAMPLES - 10}" in read_motion(path).notes


@pytest.mark.parametrize(
    ("header", "scale", "note"),
    [
        ("{}_pos_{}", 1.0, "unit: m, found from the length of the arms"),
        ("{} {} (mm)", 1000.0, None),
        ("{} {} [cm]", 1000.0, "unit: the file states cm, in which its arms have lengths of 5.3"),
        ("{}: {}[mm] ", 1.0, "unit: the file states mm, in which"),
    ],
)
def test_headers_of_csv(tmp_path, expected, header, scale, note):
    """Of units that are stated none is guessed, and one in which no person is that long is rejected."""
    motion = _markers(expected, MARKERS)
    names = ["time", *(header.format(name, axis) for name in motion.names for axis in "XYZ")]
    rows = np.c_[np.arange(SAMPLES) / RATE, scale * motion.positions.reshape(SAMPLES, -1)]
    path = tmp_path / "clip.csv"
    np.savetxt(path, rows, delimiter=",", header=f"# a capture\n{','.join(names)}", comments="")
    if note and "states" in note:
        with pytest.raises(ValueError, match=note):
            read_motion(path)
        return
    found = read_motion(path)
    np.testing.assert_allclose(found.positions, motion.positions, atol=1e-6)
    assert [line for line in found.notes if line.startswith("unit")] == ([note] if note else [])


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


def test_a_damaged_c3d_cannot_end_the_process(tmp_path):
    """ezc3d itself crashes on some of these."""
    pytest.importorskip("ezc3d", reason="the extra [mocap] is not installed")
    for content in (b"\x02P" + bytes(600), b"\x02P\x01\x00\xff\xff" * 200):
        (tmp_path / "bad.c3d").write_bytes(content)
        with pytest.raises(ValueError, match="bad.c3d.*ezc3d cannot read it"):
            read_motion(tmp_path / "bad.c3d")


def _markers(expected, names):
    """Some joints of the person, under the names of markers."""
    chosen = expected.select(list(names))
    return dataclasses.replace(chosen, names=tuple(names.values()))


MARKERS = {
    "LeftArm": "LSHO", "LeftForeArm": "LELB", "LeftHand": "LWRI", "RightArm": "RSHO", "RightForeArm": "RELB",
    "RightHand": "RWRI", "Head": "LFHD", "LeftFoot": "LANK", "RightFoot": "RANK",
}  # fmt: skip


@pytest.mark.parametrize("value", [0.0, 9999999.0])
def test_placeholders_of_what_was_not_seen_are_no_positions(tmp_path, expected, value):
    markers = _markers(expected, MARKERS)
    positions = markers.positions.copy()
    positions[20:60, markers.names.index("RWRI")] = value / 1000
    motion = read_motion(write_trc(tmp_path / "clip.trc", dataclasses.replace(markers, positions=positions)))
    assert np.isnan(motion.point("RWRI")[20:60]).all() and np.isfinite(motion.point("RWRI")[:20]).all()
    assert f"not seen: 40 positions whose three coordinates are equal ({value:g})" in motion.notes


@pytest.mark.parametrize(("digits", "rate"), [(2, 59.94), (3, 60.0)])
def test_rounded_times_are_those_of_the_stated_rate(tmp_path, expected, digits, rate):
    time = np.round(np.arange(SAMPLES) / rate, digits)
    motion = read_motion(write_trc(tmp_path / "clip.trc", _markers(expected, MARKERS), time=time, rate=rate))
    assert motion.rate == rate and len(motion.positions) == SAMPLES
    time[40:] += 0.1  # a gap is one, whatever the header states
    if digits == 3:
        gap = read_motion(write_trc(tmp_path / "gap.trc", _markers(expected, MARKERS), time=time, rate=rate))
        assert np.isnan(gap.point("RWRI")).any() and "resampled" in " ".join(gap.notes)


@pytest.mark.parametrize(("factor", "unit"), [(1e3, "milliseconds"), (1e9, "nanoseconds")])
def test_times_in_smaller_units(tmp_path, expected, factor, unit):
    time = np.arange(SAMPLES) / RATE * factor + 1e6 * factor
    motion = read_motion(write_npz(tmp_path / "p.npz", expected.names, expected.positions, time=time))
    assert motion.rate == pytest.approx(RATE, rel=1e-6) and f"time: taken for {unit}" in motion.notes


def test_a_person_who_stands_on_the_hands_is_not_turned(tmp_path):
    head, _, rows = bvh_text(SAMPLES).partition("MOTION\n")
    states, step, *frames = rows.splitlines()
    frames = [" ".join(["0 95 0", "180 0 0", *frame.split()[6:]]) for frame in frames]
    motion = read_motion(_bvh(tmp_path, "\n".join([f"{head}MOTION", states, step, *frames])))
    assert motion.notes[0].startswith("up: y, as usual for such files, though the body is along")


def test_a_person_who_leans_far_is_a_guess(tmp_path, expected):
    leaning = Rotation.from_euler("x", 50, degrees=True).as_matrix()
    motion = read_motion(write_npz(tmp_path / "p.npz", expected.names, expected.positions @ leaning.T))
    (note,) = (note for note in motion.notes if note.startswith("up: "))
    assert note.endswith("a guess, capture.up= sets it")


def test_markers_that_stand_still_while_the_arm_moves_are_left_out(tmp_path, expected):
    motion = _markers(expected, MARKERS)
    wrist = motion.index(find_arms(motion)["left"].wrist[0])
    motion.positions[10:40, wrist] = motion.positions[10, wrist]
    found = read_motion(write_trc(tmp_path / "clip.trc", motion))
    assert np.isnan(found.positions[11:40, wrist]).all() and np.isfinite(found.positions[:11]).all()
    assert "left out: 29 samples at which a marker stands still while the arm moves" in found.notes


def test_exchanged_markers_are_left_out(tmp_path, expected):
    elbow, wrist = expected.names.index("LeftForeArm"), expected.names.index("LeftHand")
    positions = expected.positions.copy()
    positions[20:30, [elbow, wrist]] = positions[20:30, [wrist, elbow]]
    motion = read_motion(write_npz(tmp_path / "p.npz", expected.names, positions))
    assert any(note.startswith("left out: 10 samples at which an arm's length") for note in motion.notes)
    assert np.isnan(motion.positions[20:30, elbow]).all()
    np.testing.assert_allclose(np.delete(motion.point("LeftHand"), range(20, 30), axis=0),
                               np.delete(expected.point("LeftHand"), range(20, 30), axis=0), atol=1e-9)  # fmt: skip


def test_up_of_markers_that_were_seen(tmp_path, expected):
    """The head is named but never seen, and a wheelchair has no heel."""
    names = {**MARKERS, "LeftFoot": "WheelchairRearL", "RightFoot": "WheelchairRearR", "Hips": "LASI", "Spine": "C7"}
    markers = _markers(expected, names)
    positions = markers.positions.copy()
    positions[:, markers.names.index("LFHD")] = np.nan
    motion = read_motion(write_trc(tmp_path / "clip.trc", dataclasses.replace(markers, positions=positions)))
    assert motion.notes == ("up: y, from the hips to the neck",)


@pytest.mark.parametrize(
    ("content", "note"),
    [
        ({"up": np.array("y")}, "up: y, as the file states"),
        ({}, "up: z, as usual for such files: a guess"),
    ],
)
def test_up_that_the_file_states_where_the_body_shows_none(tmp_path, expected, content, note):
    motion = read_motion(write_npz(tmp_path / "p.npz", ARM, expected.select(ARM).positions, **content))
    assert any(line.startswith(note) for line in motion.notes)


@pytest.mark.parametrize("mirrored", [False, True])
def test_mirrored_points_are_named(tmp_path, expected, mirrored):
    feet = {side: expected.point(f"{side}Foot") + [0.15, 0, -0.04] for side in ("Left", "Right")}
    positions = np.concatenate([expected.positions, np.stack(list(feet.values()), axis=1)], axis=1)
    positions = positions * [1, -1 if mirrored else 1, 1]
    motion = read_motion(write_npz(tmp_path / "p.npz", [*expected.names, "LeftToe", "RightToe"], positions))
    assert any("toes point backwards" in note for note in motion.notes) is mirrored


def test_one_of_several_persons_is_read(tmp_path, expected):
    markers = _markers(expected, MARKERS)
    names = tuple(f"{person}_{name}" for person in ("Ann", "Bob") for name in markers.names)
    positions = np.concatenate([markers.positions, markers.positions + [2, 0, 0]], axis=1)
    path = write_trc(tmp_path / "clip.trc", type(markers)(names, (-1,) * len(names), positions, RATE))
    motion = read_motion(path)
    assert "persons: ann, bob, of which ann is read (capture.subject=)" in motion.notes
    assert motion.names[0] == "Ann_LSHO"
    np.testing.assert_allclose(read_motion(path, subject="Bob").point("Bob_LSHO"), positions[:, 9], atol=1e-6)
    with pytest.raises(ValueError, match="subject: expected one of 'ann', 'bob', got 'Eve'"):
        read_motion(path, subject="Eve")


def test_the_first_of_points_with_one_name_counts(tmp_path, expected):
    markers = _markers(expected, MARKERS)
    twice = dataclasses.replace(
        markers, names=(*markers.names, "RANK"), parents=(-1,) * 10,
        positions=np.concatenate([markers.positions, markers.positions[:, :1]], axis=1),
    )  # fmt: skip
    motion = read_motion(write_trc(tmp_path / "clip.trc", twice))
    np.testing.assert_allclose(motion.point("RANK"), expected.point("RightFoot"), atol=1e-6)
    assert "names that occur twice, of which the first point is read: RANK" in motion.notes


def test_points_that_the_user_names(tmp_path, expected):
    names = {"RightArm": "p1", "RightForeArm": "p2", "RightHand": "p3", "Head": "p4"}
    path = write_trc(tmp_path / "clip.trc", _markers(expected, names))
    assert find_arms(read_motion(path)) == {}
    named = ArmPoints("right", ("p1",), ("p2",), ("p3",), ())
    assert find_arms(read_motion(path, arm=named)) == {"right": named}
    with pytest.raises(ValueError, match="expected shoulder, elbow and wrist of the left arm, .* of p1, p2"):
        read_motion(path, arm=ArmPoints("left", ("p1",), (), (), ()))
    with pytest.raises(ValueError, match="point: expected one of p1, p2, p3, p4, got 'p9'"):
        read_motion(path, arm=ArmPoints("left", ("p9",), (), (), ()))


def test_c3d(tmp_path, expected):
    names = ["LSHO", "LELB", "LWRA", "LFIN"]
    tracks = np.stack([expected.point(name) for name in ARM], axis=1)
    tracks[5, 1] = np.nan
    motion = read_motion(write_c3d(tmp_path / "clip.c3d", 1000 * tracks, LABELS=names))
    assert motion.names == tuple(names) and motion.rate == RATE
    np.testing.assert_allclose(motion.positions, tracks, atol=1e-6)
    content = (tmp_path / "clip.c3d").read_bytes()
    (tmp_path / "cut.c3d").write_bytes(content[: len(content) - 20 * 4 * 16])  # 20 frames of 4 points of 16 bytes
    cut = read_motion(tmp_path / "cut.c3d")
    assert len(cut.positions) < SAMPLES
    assert f"the header states {SAMPLES} frames, the file has {len(cut.positions)}" in cut.notes


def test_c3d_with_many_labels_outputs_of_models_and_a_vertical(tmp_path, expected):
    names = [*(f"X{i}" for i in range(260)), *(MARKERS[joint] for joint in list(MARKERS)[:6]), "LShoulderAngles"]
    points = np.random.default_rng(0).uniform(0, 900, (3, len(names), 3))
    points[:, 260:266] = 1000 * _markers(expected, MARKERS).positions[:3, :6]
    labels = {"LABELS": names[:255], "LABELS2": names[255:], "ANGLES": names[-1:], "Y_SCREEN": ["-Y"]}
    motion = read_motion(write_c3d(tmp_path / "clip.c3d", points, **labels))
    assert motion.names == tuple(names[:-1]) and motion.notes == ("up: y, as the file states",)
    assert set(find_arms(motion)) == {"left", "right"}
