"""Drawings of the live view: meshes of an arm, numbers, heat maps and charts."""

import mujoco
import numpy as np

import mimic
from mimic.arms.arm import ArmConfig
from mimic.envs import env_config
from mimic.viewer import html
from mimic.viewer.meshes import ArmShape, places


def test_meshes_are_placed_as_in_mujoco():
    shape = ArmShape(env_config("panda4dof").learner)
    angles = dict.fromkeys(shape.joint_names, 0.0) | {"joint2": 0.7, "joint4": -1.2}
    model = mujoco.MjModel.from_xml_path(str(mimic.arms.embodiment.panda_path()))
    data = mujoco.MjData(model)
    for name, angle in angles.items():
        data.joint(name).qpos[0] = angle
    mujoco.mj_forward(model, data)
    positions, quaternions = shape.bodies(angles)
    np.testing.assert_allclose(positions, data.xpos)
    np.testing.assert_allclose(quaternions, data.xquat)
    marked = [part.locked_joint for part in shape.parts if part.locked_joint]
    assert marked == list(shape.joint_names)
    left, right = places([shape, shape])
    assert left[1] < 0 < right[1]


def test_every_kind_of_geom_has_triangles_of_its_size(tmp_path):
    geoms = {
        "sphere": ('size=".2"', (0.4, 0.4, 0.4)),
        "capsule": ('size=".1 .2"', (0.2, 0.2, 0.6)),
        "cylinder": ('size=".1 .2"', (0.2, 0.2, 0.4)),
        "box": ('size=".1 .2 .3"', (0.2, 0.4, 0.6)),
        "ellipsoid": ('size=".1 .2 .3"', (0.2, 0.4, 0.6)),
        "mesh": ('mesh="cube"', (0.2, 0.2, 0.2)),
    }
    corners = " ".join(f"{x} {y} {z}" for x in (-0.1, 0.1) for y in (-0.1, 0.1) for z in (-0.1, 0.1))
    shapes = "".join(
        f'<geom type="{kind}" {attributes} rgba="1 {number / 10} 0 1"/>'
        for number, (kind, (attributes, _)) in enumerate(geoms.items())
    )
    (tmp_path / "arm.xml").write_text(
        f'<mujoco><asset><mesh name="cube" vertex="{corners}"/></asset><worldbody><body name="b">'
        '<joint name="a" axis="0 1 0"/><inertial pos="0 0 0" mass="1" diaginertia="1 1 1"/>'
        f'{shapes}<geom type="sphere" size="9" group="3"/><site name="tip" pos="0 0 .5"/></body></worldbody></mujoco>'
    )
    parts = ArmShape(ArmConfig(model=str(tmp_path / "arm.xml"), tip="tip")).parts[: len(geoms)]
    for number, (part, (_, extent)) in enumerate(zip(parts, geoms.values(), strict=True)):
        np.testing.assert_allclose(part.rgba, (1, number / 10, 0, 1), atol=1e-6)
        np.testing.assert_allclose(np.ptp(part.vertices, axis=0), extent, rtol=0.02)  # facets of round shapes


def test_drawings_contain_their_numbers():
    table = html.heat_maps(np.eye(2), np.array([[0.25, 3.0], [0, 1]]), ["link1", "<b>"], ["link1+link2", "tip"])
    assert all(text in table for text in (">1.00<", ">0.25<", ">3.00<", ">1+2<", "&lt;b&gt;")) and "<b>" not in table
    assert ">0.1235<" in html.numbers(0.12345, 0.1) and "…" in html.numbers(0.1, float("nan"))
    assert ">12.9<" in html.heat_maps(np.array([[12.94]]), np.eye(1), ["link1"], ["link1"])  # five do not fit
    mixed = {"hand_rotation_deg": 4.0, "centre_line_distance": 0.01, "tangent_angle_deg": 2.0}  # as jit sorts them
    shown = html.numbers(0.1, 0.1, similarity=mixed)
    assert shown.index("centre line") < shown.index("tangent angle") < shown.index("hand rotation")
    time_s, unknown = np.linspace(0, 1, 5), np.array([np.nan, np.nan, 0.1, 0.1, 0.1])
    svg = html.chart(time_s, [("distance", time_s, "red"), ("bound", unknown, "black")], now=0.5)
    assert svg.count("<polyline") == 2 and "nan" not in svg
    level = html.chart(time_s, [("distance", np.zeros(5), "red")])
    assert ">0.000<" in level and ">0.005<" in level and ">0.010<" in level  # three different ones


def test_the_chart_is_flat_while_the_arms_rest(monkeypatch):
    from mimic.commands import view_server
    from mimic.viewer.live_page import History
    from mimic.viewer.live_session import Frame

    now = iter([0.0, 1.0, 1.03, 9.0, 9.03])
    monkeypatch.setattr(view_server.time, "perf_counter", lambda: next(now))
    drawn = {}
    monkeypatch.setattr(html, "chart", lambda time, curves: drawn.update(time=time, distance=curves[0][1]) or "")
    history = History()
    for distance in (0.0, 0.0, 0.4, 0.2):
        history.add(Frame({}, {}, (), (), (), distance, 0.0, np.eye(1), np.eye(1), {}))
    history.chart()
    assert np.interp(8.9, drawn["time"], drawn["distance"]) == 0  # at rest until 9 s, no ramp from 1 s on
    assert list(drawn["distance"]) == [0.0, 0.0, 0.0, 0.4, 0.2]


def test_names_of_links_fit_their_column():
    assert html.short_names(["link1", "link2+link3", "link_hand", "tip"]) == ["1", "2+3", "hand", "tip"]
    table = html.heat_map(np.eye(2), ["upper_arm", "hand"], ["1", "2"], "W", name="w")
    assert ">upper…<" in table and ">hand<" in table and "width:3.0em" in table
    assert "em" not in html.heat_map(np.eye(2), ["1", "2"], ["1", "2"], "W", name="w").partition("<th>1")[0]
