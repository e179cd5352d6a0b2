"""Hostile MJCF and URDF files: each is rejected in one line, soon, and nothing outside the model's folder is read."""

import os
import time

import mujoco
import numpy as np
import pytest

import mimic
from mimic.arms import compile_check, model_files
from mimic.arms.compile_check import MAX_VELOCITY, check_in_process, check_magnitudes
from mimic.arms.model_files import read_model
from mimic.arms.model_source import MAX_DEPTH, MAX_ELEMENTS, read_source
from tests.helpers import original_model

SECRET = '<mujoco><worldbody><body name="secret"><geom size="1"/></body></worldbody></mujoco>'
TRIANGLES = "v 0 0 0\nv 0.1 0 0\nv 0 0.1 0\nv 0 0 0.1\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n"
BALL = '<body><joint axis="0 0 1"/><geom size="0.1"/></body>'
SECONDS = 20  # no input may take longer


@pytest.fixture
def folder(tmp_path):
    """A model's folder; `secret.xml` and `secret.obj` are outside of it."""
    (tmp_path / "secret.xml").write_text(SECRET)
    (tmp_path / "secret.obj").write_text(TRIANGLES)
    (tmp_path / "arm").mkdir()
    (tmp_path / "arm" / "link.xml").symlink_to(tmp_path / "secret.xml")
    (tmp_path / "arm" / "link.obj").symlink_to(tmp_path / "secret.obj")
    (tmp_path / "arm" / "loop.xml").symlink_to("loop.xml")
    os.mkfifo(tmp_path / "arm" / "pipe")
    return tmp_path / "arm"


def rejected(file, message):
    began = time.perf_counter()
    with pytest.raises(ValueError, match=message) as error:
        mimic.load_mjcf(file)
    assert str(error.value).splitlines() == [str(error.value)]
    assert time.perf_counter() - began < SECONDS


def with_top(part, text=None):
    """A generated arm with more at the start of its model."""
    return (text or original_model.ur_like()).replace("<worldbody>", f"{part}<worldbody>", 1)


INCLUDES = {
    "plain": '<include file="{}"/>',
    "upper case": '<INCLUDE file="{}"/>',
    "closed later": "<include  file = '{}' ></include>",
    "a > in an attribute": '<include model=">" file="{}"/>',
    "comment marks in attributes": '<include a="<!--" file="{}" b="-->"/>',
    "comment marks around": '<custom><text name="<!--" data="a"/></custom><include file="{}"/>'
    '<custom><text name="b" data="-->"/></custom>',
    "comment marks in CDATA": '<![CDATA[<!--]]><include file="{}"/><![CDATA[-->]]>',
    "lines": '<include\n\tfile\n=\n"{}"\n/>',
    "after a wrong comment": '<!-- -- --><include file="{}"/>',
    "after a declaration": '<?a <!-- ?><include file="{}"/><?b --> ?>',
}
OUTSIDE = ("../secret.xml", "..&#47;secret.xml", "&#46;&#x2e;/secret.xml", "{absolute}", "link.xml", "/etc/hosts")


@pytest.mark.parametrize("spelling", INCLUDES)
@pytest.mark.parametrize("name", OUTSIDE)
def test_includes_outside_the_folder_are_rejected_however_they_are_written(folder, spelling, name):
    text = with_top(INCLUDES[spelling].replace("{}", name.replace("{absolute}", str(folder.parent / "secret.xml"))))
    (folder / "arm.xml").write_text(text)
    malformed = spelling in ("comment marks in attributes", "comment marks around")  # what is left names no file
    rejected(folder / "arm.xml", "outside its folder|can read: |includes ''" if malformed else "outside its folder")


def test_what_is_checked_is_what_mujoco_reads(folder):
    """The parsed model is written anew, so that no text remains that two readers could understand differently."""
    (folder / "arm.xml").write_text(
        with_top(
            '<!-- a -- b --><custom><text name="a" data="&lt;include file=&quot;&#47;etc/hosts&quot;/&gt;"/></custom>'
        )
    )
    text = read_source(folder / "arm.xml").text
    assert "<include" not in text and "<!--" not in text and "&#47;" not in text
    assert "&lt;include file=&quot;/etc/hosts&quot;/&gt;" in text


ASSETS = {
    "a mesh outside": ('<asset><mesh name="z" file="../secret.obj"/></asset>', "needs '../secret.obj', .* outside"),
    "an entity": ('<asset><mesh name="z" file="..&#47;secret.obj"/></asset>', "needs '../secret.obj', .* outside"),
    "an absolute mesh": ('<asset><mesh name="z" file="/etc/hosts"/></asset>', "needs '/etc/hosts', .* outside"),
    "a link": ('<asset><mesh name="z" file="link.obj"/></asset>', "needs 'link.obj', .* outside"),
    "a texture": ('<asset><texture name="z" type="2d" file="/etc/hosts"/></asset>', "needs '/etc/hosts', .* outside"),
    "a side of a cube": (
        '<asset><texture name="z" type="cube" fileback="/etc/hosts"/></asset>',
        "needs '/etc/hosts', .* outside",
    ),
    "a height field": (
        '<asset><hfield name="z" file="../secret.obj" size="1 1 1 1"/></asset>',
        "needs '../secret.obj', .* outside",
    ),
    "a mesh folder far outside": (
        '<compiler meshdir="../../x"/><asset><mesh name="z" file="a.obj"/></asset>',
        "meshdir='../../x', which is outside",
    ),
    "a mesh that is a pipe": ('<asset><mesh name="z" file="pipe"/></asset>', "'pipe', which is not a regular file"),
    "an include that is a pipe": ('<include file="pipe"/>', "'pipe', which is not a regular file"),
    "a device": ('<include file="/dev/zero"/>', "'/dev/zero', which is outside"),
    "a folder": ('<include file="."/>', "'.', which is not a regular file"),
    "a loop of links": ('<include file="loop.xml"/>', "'loop.xml', which is outside"),
    "a long name": (f'<include file="{"x" * 5000}"/>', "which (is outside|does not exist)"),
    "a model that attaches itself": (
        '<asset><model name="z" file="arm.xml"/></asset>',
        "attaches 'arm.xml', which contains it",
    ),
}


@pytest.mark.parametrize("case", ASSETS)
def test_files_outside_the_folder_and_special_files_are_rejected(folder, case):
    part, message = ASSETS[case]
    (folder / "arm.xml").write_text(with_top(part))
    rejected(folder / "arm.xml", message)


@pytest.mark.parametrize("name", ["pipe", "loop.xml"])
def test_a_model_that_is_no_file_is_rejected(folder, name):
    rejected(folder / name, "no MJCF or URDF file at")


def test_attached_models_are_checked_too(folder):
    (folder / "other.xml").write_text(SECRET.replace("<worldbody>", '<include file="../secret.xml"/><worldbody>'))
    attach = '<worldbody><attach model="z" body="{}" prefix=""/></worldbody>'
    attach = f'<asset><model name="z" file="other.xml"/></asset>{attach}'
    (folder / "arm.xml").write_text(with_top(attach.format("secret")))
    rejected(folder / "arm.xml", "other.xml' includes '../secret.xml', which is outside its folder")
    (folder / "other.xml").write_text(SECRET.replace("secret", "stand"))
    (folder / "arm.xml").write_text(with_top(attach.format("stand")))
    assert mujoco.mj_name2id(read_model(folder / "arm.xml"), mujoco.mjtObj.mjOBJ_BODY, "stand") > 0


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (with_top("<include " * 40_000), "not well-formed"),
        (with_top("<!--" * 100_000), "MuJoCo can read: "),
        (with_top("<!-- -- -->" * 50_000 + "<x/>"), "unrecognized element"),
        (with_top("<body>" * (MAX_DEPTH + 1)), f"more than {MAX_DEPTH} levels"),
        (with_top("<a/>" * (MAX_ELEMENTS + 1)), "too many XML elements"),
        (with_top("<a " + " ".join(f'a{number}=""' for number in range(100_000)) + "/>"), "too many XML elements"),
    ],
    ids=["includes", "comments", "wrong comments", "levels", "elements", "attributes"],
)
def test_long_texts_are_rejected_soon(folder, text, message):
    (folder / "arm.xml").write_text(text)
    rejected(folder / "arm.xml", message)


SIZES = {
    "copies": (f'<worldbody><replicate count="100000">{BALL}</replicate></worldbody>', "<replicate> with count = 1"),
    "copies of copies": (
        f'<worldbody><replicate count="100"><replicate count="100">{BALL}</replicate></replicate></worldbody>',
        "<replicate> with count = 10000; expected at most 1,000",
    ),
    "a height field": ('<asset><hfield name="z" nrow="46341" ncol="46341" size="1 1 1 1"/></asset>', "nrow x ncol = "),
    "a texture": (
        '<asset><texture name="z" type="2d" builtin="flat" width="99999" height="99999"/></asset>',
        "width x height = ",
    ),
    "keyframes": ('<size nkey="2000000000"/>', "<size> with nkey = 2e"),
    "user data": ('<size nuser_body="1000000000"/>', "<size> with nuser_body = 1e"),
    "memory": ('<size memory="100T"/>', "more than 2 GiB of memory"),
    "bodies": (f"<worldbody>{BALL * 1001}</worldbody>", "the model has nbody = "),
}


@pytest.mark.parametrize("case", SIZES)
def test_sizes_are_bounded(folder, case):
    part, message = SIZES[case]
    (folder / "arm.xml").write_text(with_top(part))
    rejected(folder / "arm.xml", message)


MAGNITUDES = {
    "mass": ('mass="8.4"', 'mass="1e30"', r"mass \[kg\] of 1e\+30"),
    "position": ('pos="0 0.14 0"', 'pos="0 1e30 0"', r"position \[m\] of 1e\+30"),
    "range": ('range="-6.2 6.2"', 'range="-1e30 6.2"', r"joint range .* of -1e\+30"),
    "rotor inertia": ('armature="0.1"', 'armature="1e30"', r"rotor inertia .* of 1e\+30"),
    "damping": ('damping="1.0"', 'damping="-1"', "negative dof_damping"),
    "not a number": ('pos="0 0.14 0"', 'pos="0 nan 0"', "not a number: NaN"),
    "no colour": ('size="0.04"', 'size="0.04" rgba="nan 1 1 1"', "not a number: NaN"),
    "torque": ('ctrlrange="-150 150"', 'ctrlrange="-1e30 150"', r"actuator parameter of -1e\+30"),
}


@pytest.mark.parametrize("case", MAGNITUDES)
def test_implausible_magnitudes_are_rejected(folder, case, capfd):
    old, new, message = MAGNITUDES[case]
    text = original_model.ur_like()
    assert old in text
    (folder / "arm.xml").write_text(text.replace(old, new, 1))
    rejected(folder / "arm.xml", message)
    assert capfd.readouterr() == ("", "")  # no warning of MuJoCo's in this process, which also writes a file of them


@pytest.mark.parametrize("speed", ["nan", "-1", "1e30", "1e5", "fast"])
@pytest.mark.parametrize("kind", ["mjcf", "urdf"])
def test_implausible_velocity_limits_are_rejected(folder, kind, speed):
    if kind == "urdf":
        (folder / "arm.urdf").write_text(original_model.urdf().replace('velocity="1.0"', f'velocity="{speed}"'))
        return rejected(folder / "arm.urdf", "velocity limit")
    numeric = f'<custom><numeric name="velocity_limit" data="1 1 {speed} 1 1 1"/></custom>'
    (folder / "arm.xml").write_text(with_top(numeric, original_model.ur_like(gripper="")))
    rejected(folder / "arm.xml", "can read: .*'data'|NaN|velocity limit of .* rad/s; expected")


def test_a_compiled_model_is_checked_too():
    model = mujoco.MjModel.from_xml_string(with_top('<custom><numeric name="velocity_limit" data="1 nan"/></custom>'))
    with pytest.raises(ValueError, match=f"velocity limit of nan rad/s; expected .* at most {MAX_VELOCITY:g}"):
        mimic.load_mjcf(model)
    model = mujoco.MjModel.from_xml_string(original_model.ur_like())
    check_magnitudes(model)
    model.body_inertia[3, 0] = np.inf
    with pytest.raises(ValueError, match=r"inertia \[kg m\^2\] of inf"):
        check_magnitudes(model)


# --- the process that compiles a model first ---


def test_a_crash_of_mujoco_is_one_line():
    text = (
        '<mujoco model="m"><asset><model name="z" file="x.xml"/></asset><worldbody><body name="b"/>'
        '<attach model="z" body="b" prefix="p"/></worldbody></mujoco>'
    )
    with pytest.raises(ValueError, match=r"^MuJoCo crashes when it compiles the model \(SIG"):
        check_in_process(text, {"x.xml": text.encode()})


def test_a_model_that_takes_long_is_rejected(monkeypatch):
    monkeypatch.setattr(compile_check, "WALL_SECONDS", 1)
    text = f'<mujoco><worldbody><replicate count="100000">{BALL}</replicate></worldbody></mujoco>'
    with pytest.raises(ValueError, match="takes more than 1 s to compile"):
        check_in_process(text, {})


def test_a_model_that_needs_much_memory_is_rejected():
    text = '<mujoco><asset><texture name="z" type="2d" builtin="flat" width="60000" height="60000"/></asset></mujoco>'
    with pytest.raises(ValueError, match="more than 2 GiB of memory"):
        check_in_process(text, {})


def test_a_file_is_compiled_in_a_process_once_and_the_panda_never(folder, monkeypatch):
    calls = []
    monkeypatch.setattr(model_files, "check_in_process", lambda *_: calls.append(1))
    (folder / "arm.xml").write_text(original_model.ur_like().replace("ur_like", folder.parent.name))
    for _ in range(3):
        mimic.load_mjcf(folder / "arm.xml")
    assert len(calls) == 1
    (folder / "arm.xml").write_text((folder / "arm.xml").read_text().replace("8.4", "8.5"))
    mimic.load_mjcf(folder / "arm.xml")
    assert len(calls) == 2
    mimic.panda()
    assert len(calls) == 2


# --- what good models need ---


def test_files_of_a_package_are_found(folder):
    """Meshes next to the model's folder, by the compiler's folder or as a ROS package; textures and strippath."""
    (folder.parent / "meshes").mkdir()
    (folder.parent / "meshes" / "l.obj").write_text(TRIANGLES)
    hand = '<body><geom type="mesh" mesh="l" mass="0.1"/></body>'
    for compiler, name in (("meshdir='../meshes'", "l.obj"), ("assetdir='../meshes' strippath='true'", "C:\\x\\l.obj")):
        assets = f'<compiler {compiler}/><asset><mesh file="{name}"/></asset>'
        (folder / "arm.xml").write_text(with_top(assets, original_model.ur_like(gripper=hand)))
        assert read_model(folder / "arm.xml").nmesh == 1
    for mesh in (f"package://{folder.parent.name}/meshes/l.obj", "package://other/meshes/l.obj", "../meshes/l.obj"):
        (folder / "arm.urdf").write_text(original_model.urdf(mesh=mesh))
        assert read_model(folder / "arm.urdf").nmesh == 1


@pytest.mark.parametrize("mesh", ["package://x/../../secret.obj", "file:///etc/hosts", "../../secret.obj"])
def test_meshes_of_a_urdf_outside_its_package_are_left_out(folder, mesh, caplog):
    deep = folder / "urdf"
    deep.mkdir()
    (deep / "arm.urdf").write_text(original_model.urdf(mesh=mesh))
    assert read_model(deep / "arm.urdf").nmesh == 0
    assert f"the first {mesh}" in caplog.text


def test_messages_name_the_line_of_the_file(folder):
    (folder / "arm.xml").write_text("<mujoco>\n<!-- a\n -- b -->\n<worldbody>\n\n  <boby/>\n</worldbody></mujoco>")
    rejected(folder / "arm.xml", "Element 'boby', line 6$")
