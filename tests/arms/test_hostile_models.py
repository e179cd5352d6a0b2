"""Hostile MJCF and URDF files: each is rejected in one line, and nothing outside the model's folder is read."""

import os
import signal
import subprocess
from unittest.mock import Mock

import mujoco
import pytest

import mimic
from mimic.arms import compile_check, model_files
from mimic.arms.compile_check import MAX_VELOCITY, check_in_process
from mimic.arms.model_files import read_model
from mimic.arms.model_source import MAX_ELEMENTS, read_source
from mimic.base.limited_process import call_limited
from tests.helpers import original_model

SECRET = '<mujoco><worldbody><body name="secret"><geom size="1"/></body></worldbody></mujoco>'
TRIANGLES = "v 0 0 0\nv 0.1 0 0\nv 0 0.1 0\nv 0 0 0.1\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n"
BALL = '<body><joint axis="0 0 1"/><geom size="0.1"/></body>'


@pytest.fixture
def folder(tmp_path):
    """A model's folder; `secret.xml` and `secret.obj` are outside of it and of the folder around it."""
    folder = tmp_path / "package" / "arm"
    folder.mkdir(parents=True)
    (tmp_path / "secret.xml").write_text(SECRET)
    (tmp_path / "secret.obj").write_text(TRIANGLES)
    (folder.parent / "beside.xml").write_text(SECRET)
    (folder / "link.xml").symlink_to(tmp_path / "secret.xml")
    (folder / "link.obj").symlink_to(tmp_path / "secret.obj")
    (folder / "loop.xml").symlink_to("loop.xml")
    os.mkfifo(folder / "pipe")
    return folder


def rejected(file, message):
    """Checks that a model is rejected in one line, before MuJoCo reads it."""
    with pytest.raises(ValueError, match=message) as error:
        read_source(file)
    assert str(error.value).splitlines() == [str(error.value)]


def with_top(part, text=None):
    """A generated arm with more at the start of its model."""
    return (text or original_model.ur_like()).replace("<worldbody>", f"{part}<worldbody>", 1)


PLAIN = '<include file="{}"/>'
SPELLINGS = [
    PLAIN,
    '<INCLUDE file="{}"/>',
    "<include  file = '{}' ></include>",
    '<include model=">" file="{}"/>',
    '<include\n\tfile\n=\n"{}"\n/>',
    '<!-- -- --><include file="{}"/>',
]
OUTSIDE = ["../beside.xml", "&#46;&#x2e;&#47;beside.xml", "{absolute}", "link.xml", "/etc/hosts", "/dev/zero"]


@pytest.mark.parametrize(
    ("spelling", "name"), [*((text, OUTSIDE[0]) for text in SPELLINGS), *((PLAIN, name) for name in OUTSIDE)]
)
def test_includes_outside_the_folder_are_rejected_however_they_are_written(folder, spelling, name):
    name = name.replace("{absolute}", str(folder.parent / "beside.xml"))
    (folder / "arm.xml").write_text(with_top(spelling.replace("{}", name)))
    rejected(folder / "arm.xml", "outside its folder")


HIDDEN = [
    '<custom><text name="<!--" data="a"/></custom><include file="{}"/><custom><text name="b" data="-->"/></custom>',
    '<?a <!-- ?><include file="{}"/><?b --> ?>',
    '<![CDATA[<!--]]><include file="{}"/><![CDATA[-->]]>',
]


@pytest.mark.parametrize("spelling", HIDDEN)
def test_an_include_that_is_a_comment_to_one_reader_alone_is_left_out(folder, spelling):
    (folder / "arm.xml").write_text(with_top(spelling.replace("{}", "../beside.xml")))
    try:
        text = read_source(folder / "arm.xml").text
    except ValueError:
        return
    assert "secret" not in text and "beside" not in text


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


def mesh(name):
    return f'<asset><mesh name="z" file="{name}"/></asset>'


MODEL = '<asset><model name="z" file="../other.xml"/></asset>'
PARTS = {
    "a mesh outside": (mesh("../../secret.obj"), "needs '../../secret.obj', .* outside"),
    "a link": (mesh("link.obj"), "needs 'link.obj', .* outside"),
    "a texture": ('<asset><texture type="2d" file="/etc/hosts"/></asset>', "needs '/etc/hosts', .* outside"),
    "a mesh folder": (f'<compiler meshdir="../../x"/>{mesh("a.obj")}', "needs 'a.obj', .* outside"),
    "a mesh that is a pipe": (mesh("pipe"), "'pipe', which cannot be read: expected a regular file, got a named pipe"),
    "an include that is a pipe": (PLAIN.replace("{}", "pipe"), "'pipe', .* got a named pipe"),
    "a loop of links": (PLAIN.replace("{}", "loop.xml"), "needs 'loop.xml', which cannot be read"),
    "an include of itself": (PLAIN.replace("{}", "arm.xml"), "includes 'arm.xml' twice"),
    "an attached model": (MODEL, "needs '../other.xml', .* outside"),
    "an attached model that is absent": (MODEL.replace("../other", "other"), "'other.xml', which does not exist"),
    "an attached model that is itself": (MODEL.replace("../other", "arm"), "attaches 'arm.xml' to itself"),
    "levels": ("<body>" * 20_000 + "</body>" * 20_000, "too many levels"),
    "elements": ("<a/>" * (MAX_ELEMENTS + 1), "too many XML elements"),
}


@pytest.mark.parametrize("case", PARTS)
def test_files_outside_special_files_and_long_texts_are_rejected(folder, case):
    part, message = PARTS[case]
    (folder / "arm.xml").write_text(with_top(part))
    rejected(folder / "arm.xml", message)


@pytest.mark.parametrize("name", ["pipe", "loop.xml"])
def test_a_model_that_is_no_file_is_rejected(folder, name):
    rejected(folder / name, "no MJCF or URDF file at")


MAGNITUDES = {
    "mass": ('mass="8.4"', 'mass="1e30"', r"mass \[kg\] of 1e\+30 in body 'lift_link' \(body_mass\)"),
    "mass just above": ('mass="8.4"', 'mass="1.1e5"', r"mass \[kg\] of 110000"),
    "position": ('pos="0 0.14 0"', 'pos="0 1e30 0"', r"position \[m\] of 1e\+30"),
    "range": ('range="-6.2 6.2"', 'range="-1e30 6.2"', r"joint range .* of -1e\+30"),
    "rotor inertia": ('armature="0.1"', 'armature="1e30"', r"rotor inertia .* of 1e\+30"),
    "damping": ('damping="1.0"', 'damping="-1"', "negative dof_damping in joint 'pan'"),
    "torque": ('ctrlrange="-150 150"', 'ctrlrange="-1e30 150"', r"actuator parameter of -1e\+30"),
    "bodies": ("<worldbody>", f"<worldbody>{BALL * 1001}", "the model has nbody = "),
    **{
        f"speed {speed}": (
            "<worldbody>",
            f'<custom><numeric name="velocity_limit" data="1 1 1 1 1 {speed}"/></custom><worldbody>',
            f"velocity limit of .* rad/s in joint 'wrist_3'; expected .* at most {MAX_VELOCITY:g}",
        )
        for speed in ("-1", "1e5", "nan")
    },
}


@pytest.mark.parametrize("case", MAGNITUDES)
def test_implausible_magnitudes_are_rejected(case):
    old, new, message = MAGNITUDES[case]
    text = original_model.ur_like()
    assert old in text
    with pytest.raises(ValueError, match=message):
        mimic.load_mjcf(mujoco.MjModel.from_xml_string(text.replace(old, new, 1)))


@pytest.mark.parametrize("speed", ["nan", "fast"])
def test_implausible_velocity_limits_of_a_urdf_are_rejected(folder, monkeypatch, speed):
    monkeypatch.setattr(model_files, "check_in_process", lambda *_: None)
    (folder / "arm.urdf").write_text(original_model.urdf().replace('velocity="1.0"', f'velocity="{speed}"'))
    with pytest.raises(ValueError, match="velocity limit"):
        read_model(folder / "arm.urdf")


# --- the process that compiles a model first ---

HARMFUL = {
    "time": (f'<mujoco><worldbody><replicate count="100000">{BALL}</replicate></worldbody></mujoco>', "more than 1 s"),
    "memory": ('<mujoco><size memory="100T"/></mujoco>', "more than 2 GiB of memory"),
    "not a number": ('<mujoco><worldbody><geom size="1" rgba="nan 1 1 1"/></worldbody></mujoco>', "not a number: NaN"),
}


@pytest.mark.slow_for("time")
@pytest.mark.parametrize("case", HARMFUL)
def test_a_model_that_does_harm_is_one_line(monkeypatch, capfd, case):
    monkeypatch.setattr(compile_check, "SECONDS", 1 if case == "time" else 10)
    text, message = HARMFUL[case]
    with pytest.raises(ValueError, match=message) as error:
        check_in_process(text)
    assert str(error.value).splitlines() == [str(error.value)]
    assert capfd.readouterr() == ("", "")


def test_the_end_of_a_process_by_its_limit_of_time_is_one_line(monkeypatch):
    ended = subprocess.CompletedProcess((), -signal.SIGXCPU, b"", b"")
    for end in (lambda *_, **__: ended, Mock(side_effect=subprocess.TimeoutExpired((), 50))):
        monkeypatch.setattr(subprocess, "run", end)
        with pytest.raises(ValueError, match="^the model takes mujoco more than 10 s to read$"):
            check_in_process("<mujoco/>")


def test_a_crash_is_one_line(tmp_path):
    (tmp_path / "crash.py").write_text("import os\n\n\ndef read():\n    os.abort()\n")
    with pytest.raises(ValueError, match=r"^json crashes with the file \(SIGABRT\)$"):
        call_limited(str(tmp_path / "crash.py"), "read", library="json", what="the file", seconds=10)


def test_a_file_is_compiled_in_a_process_once_and_the_panda_never(folder, monkeypatch):
    calls = []
    monkeypatch.setattr(model_files, "check_in_process", lambda *_: calls.append(1))
    (folder / "arm.xml").write_text(original_model.ur_like().replace("ur_like", folder.parents[1].name))
    for _ in range(3):
        mimic.load_mjcf(folder / "arm.xml")
    assert len(calls) == 1
    (folder / "arm.xml").write_text((folder / "arm.xml").read_text().replace("8.4", "8.5"))
    mimic.load_mjcf(folder / "arm.xml")
    assert len(calls) == 2
    mimic.panda()
    assert len(calls) == 2


# --- what good models need ---


def test_files_of_a_package_are_found(folder, monkeypatch):
    """Meshes next to the model's folder, by the compiler's folder or as a ROS package; textures and strippath."""
    monkeypatch.setattr(model_files, "check_in_process", lambda *_: None)
    (folder.parent / "meshes").mkdir()
    (folder.parent / "meshes" / "l.obj").write_text(TRIANGLES)
    hand = '<body><geom type="mesh" mesh="l" mass="0.1"/></body>'
    for compiler, name in (("meshdir='../meshes'", "l.obj"), ("assetdir='../meshes' strippath='true'", "C:\\x\\l.obj")):
        assets = f'<compiler {compiler}/><asset><mesh file="{name}"/></asset>'
        (folder / "arm.xml").write_text(with_top(assets, original_model.ur_like(gripper=hand)))
        assert read_model(folder / "arm.xml").nmesh == 1
    for name in ("package://package/meshes/l.obj", "package://other/meshes/l.obj", "../meshes/l.obj"):
        (folder / "arm.urdf").write_text(original_model.urdf(mesh=name))
        assert read_model(folder / "arm.urdf").nmesh == 1


@pytest.mark.parametrize("name", ["package://x/../../secret.obj", "file:///etc/hosts", "../../secret.obj"])
def test_meshes_of_a_urdf_outside_its_package_are_left_out(folder, name):
    (folder / "arm.urdf").write_text(original_model.urdf(mesh=name))
    source = read_source(folder / "arm.urdf")
    assert not source.files and set(source.missing) == {name}


def test_messages_name_the_line_of_the_file(folder):
    text = "<mujoco>\n<!-- a\n -- b -->\n<option\n timestep='0.01'/><worldbody>\n\n  <boby/>\n</worldbody></mujoco>"
    (folder / "arm.xml").write_text(text)
    with pytest.raises(ValueError, match="Element 'boby', line 7$"):
        read_model(folder / "arm.xml")
