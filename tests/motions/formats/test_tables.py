"""Tables of joint motions as people have them: with and without a header, with other separators, units and clocks."""

import gzip

import numpy as np
import pytest

from mimic.motions.formats.tables import is_folder_of_tables, read_folder_of_tables, read_table

JOINTS = ("shoulder", "elbow")
TIME = 0.02 * np.arange(50)  # s
QPOS = np.round(0.5 * np.sin(2 * TIME[:, None] + [0, 1]), 6)
QVEL = np.round(np.cos(2 * TIME[:, None] + [0, 1]), 6)


def text(header, *columns, separator=",", decimal="."):
    rows = np.column_stack(columns)
    lines = [separator.join(f"{value:.6f}".replace(".", decimal) for value in row) for row in rows]
    return "\n".join([*([separator.join(header)] if header else []), *lines]) + "\n"


def read(tmp_path, content, name="table.csv"):
    (tmp_path / name).write_bytes(content if isinstance(content, bytes) else content.encode())
    return read_table(tmp_path / name, JOINTS)


HEADER = ["time", *JOINTS, "qdot_shoulder", "qdot_elbow"]
SPELLINGS = {
    "semicolons": text(HEADER, TIME, QPOS, QVEL, separator=";"),
    "decimal commas": text(HEADER, TIME, QPOS, QVEL, separator=";", decimal=","),
    "tabs": text(HEADER, TIME, QPOS, QVEL, separator="\t"),
    "blanks without a header": text([], TIME, QPOS, QVEL, separator="  "),
    "without a header": text([], TIME, QPOS, QVEL),
    "with torques": text([], TIME, QPOS, QVEL, 3 * QVEL),
    "a comment as header": "# log of a robot\n# " + text(HEADER, TIME, QPOS, QVEL),
    "a byte order mark and quotes": "\ufeff" + text([f'"{name}"' for name in HEADER], TIME, QPOS, QVEL),
    "milliseconds": text(["time_ms", *HEADER[1:]], 1000 * TIME, QPOS, QVEL),
    "a clock": text(["timestamp", *HEADER[1:]], 1_700_000_000_000 + 1000 * TIME, QPOS, QVEL),
    "PlotJuggler": text(["__time", *(f"/js/{name}/{what}" for what in ("position", "velocity") for name in JOINTS)],
                        1.7e9 + TIME, QPOS, QVEL),
    "a robot's own log": text(["timestamp", "target_q_0", "target_q_1", "actual_q_0", "actual_q_1", "actual_qd_0",
                               "actual_qd_1"], TIME, QPOS + 0.01, QPOS, QVEL, separator=" "),
    "words and dates": "stamp,frame_id,shoulder,elbow,qdot_shoulder,qdot_elbow\n" + "".join(
        f"2024-05-01T12:00:0{row[0]:.6f}Z,base,{','.join(f'{value:.6f}' for value in row[1:])}\n"
        for row in np.column_stack([TIME, QPOS, QVEL])
    ),
    "decimal commas between tabs": text(HEADER, TIME, QPOS, QVEL, separator="\t", decimal=","),
    "a topic of ROS": text(["%time", "field.header.seq", "field.position0", "field.position1", "field.velocity0",
                            "field.velocity1"], 1.7e9 + TIME, 9 + TIME, QPOS, QVEL),
    "elements of arrays": text(["time", "q[0]", "q[1]", "dq[0]", "dq[1]"], TIME, QPOS, QVEL),
    "other columns": text(["frame", *HEADER, "force_x"], 50 * TIME, TIME, QPOS, QVEL, 9 + TIME),
}  # fmt: skip


@pytest.mark.parametrize("spelling", SPELLINGS)
def test_tables_are_read(tmp_path, spelling):
    (motion,) = read(tmp_path, SPELLINGS[spelling]).motions.values()
    np.testing.assert_allclose(motion.time, TIME, atol=1e-6)
    np.testing.assert_allclose(motion.qpos, QPOS, atol=1e-12)
    assert motion.qvel is not None
    np.testing.assert_allclose(motion.qvel, QVEL, atol=1e-12)


@pytest.mark.parametrize("header", [[], list(JOINTS)])
def test_a_table_without_times_needs_a_rate(tmp_path, header):
    (tmp_path / "table.csv").write_text(text(header, QPOS))
    (motion,) = read_table(tmp_path / "table.csv", JOINTS, rate=50).motions.values()
    np.testing.assert_allclose(motion.time, TIME, atol=1e-12)
    np.testing.assert_allclose(motion.qpos, QPOS, atol=1e-12)


def test_assumptions_about_a_table_are_lines(tmp_path):
    (tmp_path / "table.csv").write_text(text(["time", *JOINTS], TIME, QPOS))
    recording = read_table(tmp_path / "table.csv", JOINTS, rate=100)
    assert recording.notes == ("times: 100 samples a second, as rate= says, and not those of time",)
    assert read(tmp_path, SPELLINGS["without a header"]).notes == (
        "no header: the columns are time, then the angles and velocities of 2 joints",
        "joints: 1, 2, found by their order; joints=[...] names others",
    )
    assert read(tmp_path, SPELLINGS["a clock"]).notes == ("times: in ms, as those of a clock since 1970",)


def test_units_grippers_and_missing_cells(tmp_path):
    content = text(["t", "shoulder [deg]", "elbow (Deg.)", "gripper"], TIME, QPOS, TIME).replace("0.500000", "N/A")
    recording = read(tmp_path, content)
    (motion,) = recording.motions.values()
    assert recording.unit == "deg" and recording.gripper == ("gripper",) and motion.gripper is not None
    np.testing.assert_allclose(motion.gripper[:, 0], np.where(np.isclose(TIME, 0.5), np.nan, TIME))


def test_a_first_row_without_a_time_is_none_of_the_motion(tmp_path):
    (motion,) = read(tmp_path, text(["time", *JOINTS], TIME, QPOS).replace("0.000000,", ",", 1)).motions.values()
    assert np.isnan(motion.time[0])
    np.testing.assert_allclose(motion.time[1:], TIME[1:] - TIME[1], atol=1e-9)


def test_a_packed_folder_with_a_table_for_each_quantity(tmp_path):
    for name, values in {"run_time": TIME, "run_positions": QPOS, "run_velocity": QVEL, "run_torques": QVEL}.items():
        (tmp_path / f"{name}.txt.gz").write_bytes(gzip.compress("\n".join(map(str, values.ravel())).encode()))
    assert is_folder_of_tables(tmp_path)
    (motion,) = read_folder_of_tables(tmp_path, JOINTS).motions.values()
    for values, expected in zip(motion[:3], (TIME, QPOS, QVEL), strict=True):
        np.testing.assert_array_equal(values, expected)
    with pytest.raises(ValueError, match="has 50 times and 100 numbers as pos, expected 50 of each of a, b, c"):
        read_folder_of_tables(tmp_path, ("a", "b", "c"))
    (tmp_path / "more_positions.csv").write_text("1\n")
    assert not is_folder_of_tables(tmp_path)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("", "is no table of numbers below a header: it has no rows"),
        ("time,shoulder,elbow\n0,1,x\n", "has no number in the column of elbow"),
        ("time,shoulder,elbow\n0,1,x\n1,1,2\n", "expected a number, got 'x'"),
        ("time,shoulder,elbow\n0,1,2\n0,1\n", "row 2 has 2 cells, expected 3"),
        ("time,shoulder,elbow\n", "has no rows"),
        ("shoulder,elbow\n1,2\n", "lacks time; got the columns shoulder, elbow"),
        ("time,shoulder\n1,2\n", "has no table with the joints shoulder, elbow; its joint angles: columns .shoulder"),
        ("time,shoulder,elbow,dq_elbow\n0,1,2,3\n", "has velocities of some joints, but none of shoulder"),
        ("0,1,2,3\n", "has no header and 4 columns; expected time and the angles of 2 joints"),
        ("time,shoulder,elbow\n0,1,2\n20,1,2\n40,1,2\n", "are 20 s apart, expected less than .* time_ms"),
        ("time,shoulder,elbow\n12:00:00,1,2\n12:00:01,1,2\n", "has no number as time, nor dates as"),
        ("time,shoulder,elbow,shoulder,elbow\n0,1,2,3,4\n", "several columns with the name of shoulder"),
        ("time,shoulder [mrad],elbow [mrad]\n0,1,2\n", "has elbow in 'mrad'; expected all angles in rad, in deg"),
        ("time,shoulder [deg],elbow [rad]\n0,1,2\n", "has shoulder in 'deg', elbow in 'rad'; expected all angles"),
        ("time,shoulder,elbow\n0,1,2,\n1,1,2,\n", "its rows have 4 cells, its header 3"),
        ("time [min],shoulder,elbow\n0,1,2\n", "are in 'min', expected s, sec, ms"),
        (b"\xff\xfe\x00", "expected text in UTF-8"),
    ],
)
def test_tables_that_cannot_be_read(tmp_path, content, message):
    with pytest.raises(ValueError, match=message) as error:
        read(tmp_path, content)
    assert "\n" not in str(error.value)


def test_a_damaged_packed_table_is_rejected(tmp_path):
    packed = gzip.compress(SPELLINGS["tabs"].encode())
    for content in (packed[:-20], b"time", packed[:20] + b"xx" + packed[22:]):
        with pytest.raises(ValueError, match="is no table of numbers"):
            read(tmp_path, content, "table.tsv.gz")
