"""Damaged and hostile MJCF and URDF files, and the meshes and textures next to them."""

import functools
import os
import re
import struct
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
from numpy.random import Generator

import mimic
from benchmarks.fuzzing import ACCEPTED, OTHER_NUMBERS, Case
from mimic.arms.arm import ArmConfig, build_arm
from mimic.arms.model_files import read_model
from mimic.arms.model_source import read_source

SEED = 26
_FOLDER, _SECRET = "arm", "secret"  # the model's folder, and a body that is in files outside of it alone
_OUTSIDE = f'<mujoco><worldbody><body name="{_SECRET}"><geom size="1"/></body></worldbody></mujoco>'
_TETRAHEDRON = "v 0 0 0\nv 0.1 0 0\nv 0 0.1 0\nv 0 0 0.1\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n"


def _mjcf() -> str:
    bodies = ""
    for number in range(5):
        axis = "0 0 1" if number % 2 == 0 else "0 1 0"
        bodies += f"""
  <body name="body{number}" pos="0.0{number} 0 0.3">
   <joint name="turn{number}" axis="{axis}" range="-150 150" armature="0.02" damping="0.1"/>
   <geom type="capsule" size="0.03" fromto="0 0 0 0 0 0.25" mass="{3 - 0.5 * number}"/>"""
    motors = "".join(f'<motor joint="turn{number}" ctrlrange="-50 50"/>' for number in range(5))
    return f"""<?xml version="1.0"?>
<mujoco model="fuzzed"><!-- an arm -- with a comment -->
 <compiler angle="degree" autolimits="true" meshdir="meshes"/>
 <default><geom contype="0" conaffinity="0"/></default>
 <asset><mesh name="tool" file="tool.obj"/><texture name="grid" type="2d" file="grid.png"/>
  <material name="m" texture="grid"/>
  <hfield name="floor" nrow="4" ncol="4" size="1 1 0.1 0.1"/></asset>
 <worldbody><geom type="hfield" hfield="floor" pos="0 0 -1"/>{bodies}
  <body name="tool" pos="0 0 0.3"><geom type="mesh" mesh="tool" material="m" mass="0.1"/>
   <site name="tip" pos="0 0 0.1"/></body>
 {"</body>" * 5}</worldbody>
 <actuator>{motors}</actuator>
 <include file="parts.xml"/>
 <keyframe><key name="home" qpos="0 0.1 0 0.1 0"/></keyframe>
</mujoco>"""


_PARTS = '<mujocoinclude><custom><numeric name="velocity_limit" data="1 2 3 4 5"/></custom></mujocoinclude>'


def _urdf() -> str:
    text = '<?xml version="1.0"?>\n<robot name="fuzzed"><link name="base"/>'
    parent = "base"
    for number in range(4):
        axis = "0 0 1" if number % 2 == 0 else "0 1 0"
        text += f"""
 <link name="l{number}"><inertial><origin xyz="0 0 0.1"/><mass value="2"/>
   <inertia ixx="0.02" iyy="0.02" izz="0.01" ixy="0" ixz="0" iyz="0"/></inertial>
  <collision><geometry><mesh filename="meshes/tool.obj"/></geometry></collision></link>
 <joint name="j{number}" type="revolute"><parent link="{parent}"/><child link="l{number}"/>
  <origin xyz="0.02 0 0.25" rpy="0 0.1 0"/><axis xyz="{axis}"/>
  <limit lower="-2.5" upper="2.5" effort="40" velocity="2"/></joint>"""
        parent = f"l{number}"
    return text + "\n</robot>"


@functools.cache
def _panda() -> str:
    return Path(mimic.arms.embodiment.panda_path()).read_text()


def _png(width: int, height: int, rows: int) -> bytes:
    def chunk(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    header = struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
    pixels = zlib.compress((b"\0" + bytes(3 * min(width, 4096))) * rows)
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + chunk(b"IDAT", pixels) + chunk(b"IEND", b"")


# --- text ---

Edit = Callable[[str, Generator], str]
_NUMBERS = ["nan", "inf", "-inf", "1e30", "-1e30", "1e400", "1e-320", "-1", "0", "99999999999", "0x10", "1e5", "",
            "1 2 3 4",
            "1,2", "--1", "1e39", "1e11", "12345678901234567890", "true", "ten", "\u0661"]  # fmt: skip
_WORDS = ["", "world", "a\u2028b", "x" * 5000, "../..", "/etc/hosts", "&#10;", "&#0;", "&lt;", "%s%n", "nan", "panda",
          "\u202e",
          "tip", "&amp;#47;", "fixed", "free", "ball", "slide", "mesh"]  # fmt: skip


def _number_changed(text: str, rng: Generator) -> str:
    matches = list(re.finditer(r"(?<=[\" ])-?\d+\.?\d*(?=[\" ])", text))
    for _ in range(int(rng.integers(1, 3))):
        match = matches[int(rng.integers(len(matches)))]
        if text[match.start() : match.end()] == match.group():
            text = text[: match.start()] + _pick(rng, _NUMBERS) + text[match.end() :]
    return text


def _value_changed(text: str, rng: Generator) -> str:
    match = _pick(rng, list(re.finditer(r'"[^"<>]*"', text)))
    return f'{text[: match.start()]}"{_pick(rng, _WORDS)}"{text[match.end() :]}'


def _name_changed(text: str, rng: Generator) -> str:
    match = _pick(rng, list(re.finditer(r"(?<=[< /])[a-z]+(?=[ =/>])", text)))
    return (
        text[: match.start()] + _pick(rng, [match.group().upper(), "x", "a:b", "body", "include"]) + text[match.end() :]
    )


def _flipped(text: str, rng: Generator) -> str:
    changed = bytearray(text.encode())
    for _ in range(int(rng.integers(1, 6))):
        changed[int(rng.integers(len(changed)))] ^= 1 << int(rng.integers(8))
    return changed.decode("latin-1")


def _cut(text: str, rng: Generator) -> str:
    return text[: int(rng.integers(len(text)))]


def _without_part(text: str, rng: Generator) -> str:
    start = int(rng.integers(len(text)))
    return text[:start] + text[start + int(rng.integers(1, 300)) :]


def _doubled(text: str, rng: Generator) -> str:
    start, end = sorted(rng.integers(len(text), size=2))
    return text[:end] + text[start:]


def _element_moved(text: str, rng: Generator) -> str:
    elements = list(re.finditer(r"<[a-z]+ [^<>]*/>", text))
    match, other = _pick(rng, elements), _pick(rng, elements)
    return text[: other.start()] + match.group() + text[other.start() :]


def _random_bytes(text: str, rng: Generator) -> str:
    return rng.bytes(int(rng.integers(3000))).decode("latin-1")


def _repeated(text: str, rng: Generator) -> str:
    """Text of which a slow reader takes long: open tags, comments, attributes, levels, entities."""
    count = int(_pick(rng, [1000, 40_000, 400_000]))
    entities = "".join(f'<!ENTITY l{i} "{f"&l{i - 1};" * 10}">' for i in range(1, 10))
    parts = [
        "<include " * count, "<include file=" * count, "<!--" * count, "<!-- -- -->" * count, "<a>" * count,
        "<a/>" * count,
        "<a " + " ".join(f'a{i}=""' for i in range(count // 4)) + "/>", "&lt;" * count, "<![CDATA[" * count,
        "]]>" * count,
        "<body>" * count, '<body><geom size="1"/>' * (count // 100), '<geom size="1"/>' * (count // 10), " " * count,
        "<" * count,
        '<include file="parts.xml"/>' * (count // 100), "\n" * count, '<a b="' + ">" * count + '"/>',
        '<joint name="j" axis="0 0 1"/>' * (count // 100), "<?a ?>" * count,
    ]  # fmt: skip
    bomb = f'<!DOCTYPE m [<!ENTITY l0 "ha">{entities}]>'
    if rng.integers(8) == 0:
        return bomb + text.replace("fuzzed", "&l9;")
    return _inserted(text, _pick(rng, parts), rng)


def _inserted(text: str, part: str, rng: Generator) -> str:
    places = [
        match.end() for match in re.finditer(r"<worldbody>|<asset>|<robot [^>]*>|<mujoco [^>]*>|<body [^>]*>", text)
    ]
    at = _pick(rng, places or [0])
    return text[:at] + part + text[at:]


def _at_top(text: str, part: str) -> str:
    return re.sub(r"<(mujoco|robot)\b[^>]*>", lambda match: match.group() + part, text, count=1)


def _include(text: str, rng: Generator) -> str:
    """Includes of files outside the folder, in many spellings."""
    name = _pick(rng, ["../outside.xml", "..&#47;outside.xml", "&#46;&#46;/outside.xml", "{0}", "&#47;etc&#47;hosts",
                       "/etc/hosts",
                       "link.xml", "folder/../../outside.xml", "./..//outside.xml", "..\\outside.xml", "", ".",
                       "parts.xml",
                       "model.xml", "/proc/self/environ", "/dev/zero", "missing.xml", "pipe", "%2e%2e/outside.xml",
                       "x" * 5000, "loop.xml", "..&#x2f;outside.xml", "file:../outside.xml", "deep.xml"])  # fmt: skip
    forms = [
        '<include file="{}"/>', "<INCLUDE file='{}'/>", '<Include file = "{}" ></Include>',
        '<include a="&gt;" file="{}"/>',
        '<include a=">" file="{}"/>', '<include a="<!--" file="{}" b="-->"/>',
        '<!-- <a b="--> <include file="{}"/> <!-- "/> -->',
        '<![CDATA[<!--]]><include file="{}"/><![CDATA[-->]]>', '<include\n\tfile\n=\n"{}"\n/>',
        '<x:include file="{}"/>',
        '<default><include file="{}"/></default>', '<!-- -- --><include file="{}"/>',
        '<?a <!-- ?><include file="{}"/><?b --> ?>',
    ]  # fmt: skip
    return _inserted(text, _pick(rng, forms).replace("{}", name), rng)


def _asset(text: str, rng: Generator) -> str:
    """Meshes and textures that are no files of the model's folder."""
    names = ["../../outside.obj", "/etc/hosts", "..&#47;..&#47;outside.obj", "pipe", "/dev/zero", "link.obj",
             "missing.obj", ".",
             "../outside.obj", "&#47;dev&#47;stdin", "/proc/self/mem", "package://etc/hosts.stl",
             "package://../outside.obj",
             "package://meshes/../../../outside.obj", "file:///etc/hosts", "x" * 3000, "loop.xml",
             "tool.obj"]  # fmt: skip
    name = _pick(rng, names)
    forms = [
        '<asset><mesh name="z" file="{}"/></asset>', '<asset><texture name="z" type="2d" file="{}"/></asset>',
        '<asset><hfield name="z" size="1 1 1 1" file="{}"/></asset>', '<asset><skin name="z" file="{}"/></asset>',
        '<deformable><skin name="z" file="{}"/></deformable>', '<asset><model name="z" file="{}"/></asset>',
        '<compiler assetdir="{}"/>', '<compiler strippath="true"/><asset><mesh name="z" file="{}"/></asset>',
        '<asset><texture name="z" type="cube" fileright="{}" fileleft="{}"/></asset>',
    ]  # fmt: skip
    text = text.replace("tool.obj", name) if rng.integers(2) else text
    return _at_top(text, _pick(rng, forms).replace("{}", name))


def _sizes(text: str, rng: Generator) -> str:
    """A few characters that ask for much."""
    count = _pick(rng, ["10", "100000", "1000000000", "1e9", "-5", "nan", "2147483647", "99999999999"])
    ball = '<body><joint axis="0 0 1"/><geom size="0.1"/></body>'
    forms = [
        f'<worldbody><replicate count="{count}" euler="0 0 1">{ball}</replicate></worldbody>',
        f'<worldbody><replicate count="100"><replicate count="{count}">{ball}</replicate></replicate></worldbody>',
        f'<asset><hfield name="z" nrow="{count}" ncol="{count}" size="1 1 1 1"/></asset>',
        f'<asset><texture name="z" type="2d" builtin="flat" width="{count}" height="{count}"/></asset>',
        f'<custom><numeric name="z" size="{count}"/></custom>', f'<size memory="{count}G"/>',
        f'<size nuser_body="{count}"/>',
        f'<size nkey="{count}"/>', f'<size nstack="{count}" njmax="{count}" nconmax="{count}"/>',
        f'<size nuser_geom="{count}"/>',
        f'<worldbody><body><flexcomp name="z" type="grid" count="{count} 9 9"/></body></worldbody>',
        f'<worldbody><composite type="cable" count="{count} 1 1" size="1"><geom size=".01"/></composite></worldbody>',
        f'<asset><mesh name="z" builtin="sphere" params="{count}"/></asset>', f'<option timestep="{count}"/>',
        '<asset><model name="z" file="model.xml"/></asset><worldbody><attach model="z" prefix="p"/></worldbody>',
        '<worldbody><attach model="fuzzed" body="body0" prefix="p"/></worldbody>', '<size njmax="100000000"/>',
        '<asset><model name="z" file="other.xml"/></asset><worldbody><attach model="z" prefix="p"/></worldbody>',
        '<asset><model file="other.xml" name="o"/></asset>'
        '<worldbody><attach prefix="" model="o" body="b"/></worldbody>',
    ]  # fmt: skip
    return _at_top(text, _pick(rng, forms))


def _links(text: str, rng: Generator) -> str:
    """Loops, lost links and strange joints of a URDF or MJCF."""
    pairs = [
        ('child link="l1"', 'child link="l0"'), ('parent link="base"', 'parent link="l3"'), ('parent link="l1"',
        'parent link="x"'),
        ('velocity="2"', 'velocity="nan"'), ('velocity="2"', 'velocity="inf"'), ('velocity="2"', 'velocity="-1"'),
        ('velocity="2"', 'velocity="1e30"'), ('velocity="2"', 'velocity="fast"'), ('effort="40"', 'effort="nan"'),
        ('effort="40"', 'effort="1e30"'), ('type="revolute"', 'type="continuous"'), ('type="revolute"',
        'type="floating"'),
        ('lower="-2.5"', 'lower="1e30"'), ('lower="-2.5"', 'lower="nan"'), ('mass value="2"', 'mass value="1e30"'),
        ('mass value="2"', 'mass value="-2"'), ('ixx="0.02"', 'ixx="1e20"'), ('ixx="0.02"', 'ixx="nan"'),
        ('xyz="0.02 0 0.25"', 'xyz="1e30 0 0"'), ('axis xyz="0 0 1"', 'axis xyz="0 0 0"'), ('name="j1"', 'name="j0"'),
        ('data="1 2 3 4 5"', 'data="nan 2 3 4 5"'), ('pos="0.01 0 0.3"', 'pos="1e30 0 0"'), ('mass="2.5"',
        'mass="1e30"'),
        ('axis="0 0 1"', 'axis="0 0 0"'), ('range="-150 150"', 'range="nan nan"'), ('range="-150 150"',
        'range="150 -150"'),
        ('damping="0.1"', 'damping="-5"'), ('armature="0.02"', 'armature="1e30"'), ('size="0.03"', 'size="1e30"'),
        ('name="turn1"', 'name="turn0"'), ('model="fuzzed"', 'model="&#10;fuzzed"'), ('name="turn0"', 'name="a&#10;b"'),
        ('ctrlrange="-50 50"', 'ctrlrange="nan 50"'), ('qpos="0 0.1 0 0.1 0"', 'qpos="nan 0 0 0 1e30"'),
    ]  # fmt: skip
    possible = [pair for pair in pairs if pair[0] in text]
    if not possible:
        return _number_changed(text, rng)
    old, new = _pick(rng, possible)
    return text.replace(old, new, int(rng.integers(1, 4)))


def _encoded(text: str, rng: Generator) -> bytes:
    encoding = _pick(rng, ["utf-16", "utf-32", "utf-8-sig", "cp037", "utf-7", "latin-1"])
    declared = _pick(rng, [encoding, "utf-8", "cp037", "UTF-16", "x-unknown", "rot13"])
    return text.replace('version="1.0"', f'version="1.0" encoding="{declared}"', 1).encode(encoding, "replace")


EDITS: dict[str, Edit] = {
    "a number": _number_changed,
    "a value": _value_changed,
    "a name": _name_changed,
    "flipped bits": _flipped,
    "truncated": _cut,
    "a part removed": _without_part,
    "a part doubled": _doubled,
    "an element moved": _element_moved,
    "random bytes": _random_bytes,
    "repeated text": _repeated,
    "an include": _include,
    "an asset": _asset,
    "sizes": _sizes,
    "links and limits": _links,
}

# --- files ---


def _damaged_mesh(folder: Path, rng: Generator) -> None:
    """Another content of the mesh, as an OBJ or STL file."""
    triangles = int(_pick(rng, [0, 1, 4, 1000, 2**20, 2**31, 2**32 - 1]))
    stl = bytes(80) + struct.pack("<I", triangles) + rng.bytes(50 * min(triangles, 1000))
    numbers = " ".join(map(str, range(1, 1000)))
    texts = [
        "", "v 0 0 0\n", _TETRAHEDRON.replace("0.1", "nan"), _TETRAHEDRON.replace("0.1", "1e30"), "f 1 2 3\n",
        "v 1\nf 1 1 1\n",
        _TETRAHEDRON.replace("f 1 3 2", "f 1 3 99999999999"), _TETRAHEDRON.replace("f 1 3 2", "f -1 -3 -2"),
        "mtllib /etc/hosts\n",
        _TETRAHEDRON.replace("0.1", "0"), _TETRAHEDRON.replace("f 1 3 2", f"f {numbers}"),
        _TETRAHEDRON.replace("0 0 0.1", "0 0"),
        "v 0 0 0\n" * 100_000, _flipped(_TETRAHEDRON, rng), _TETRAHEDRON.replace("0.1", "1e-30"),
        "usemtl a\n" * 1000 + _TETRAHEDRON,
    ]  # fmt: skip
    if rng.integers(2):
        (folder / "meshes" / "tool.obj").write_text(_pick(rng, texts))
    else:
        (folder / "meshes" / "tool.obj").unlink()
        (folder / "meshes" / "tool.stl").write_bytes(stl)
        for file in folder.glob("model.*"):
            file.write_text(file.read_text().replace("tool.obj", "tool.stl"))


def _damaged_texture(folder: Path, rng: Generator) -> None:
    width, height = _pick(rng, [(0, 0), (4, 4), (50_000, 50_000), (2**31 - 1, 2**31 - 1), (4096, 4096), (2**32 - 1, 1)])
    data = _png(width, height, int(_pick(rng, [0, 4, 4096])))
    start = int(rng.integers(len(data)))
    (folder / "grid.png").write_bytes(data if rng.integers(2) else data[:start] + rng.bytes(4) + data[start + 4 :])


def _strange_file(folder: Path, rng: Generator) -> None:
    """One of the files is a pipe, a device, a folder, a link, without permission, or gone."""
    file = _pick(
        rng, [next(folder.glob("model.*")), folder / "parts.xml", folder / "meshes" / "tool.obj", folder / "grid.png"]
    )
    content = file.read_bytes()
    file.unlink()
    kinds: list[Callable[[], Any]] = [
        lambda: os.mkfifo(file), file.mkdir, lambda: file.symlink_to("/dev/zero"), lambda: file.symlink_to("/dev/full"),
        lambda: file.symlink_to(file.name), lambda: file.symlink_to("/etc/hosts"), lambda: file.write_bytes(b""),
        lambda: None,
        lambda: file.symlink_to(folder.parent / "outside.xml"), lambda: file.symlink_to("/proc/self/environ"),
        lambda: file.write_bytes(content[: len(content) // 2]), lambda: os.truncate(_touched(file), 2**33),
    ]  # fmt: skip
    _pick(rng, kinds)()


def _touched(file: Path) -> Path:
    file.touch()
    return file


FILE_DAMAGES: dict[str, Callable[[Path, Generator], None]] = {
    "a mesh": _damaged_mesh,
    "a texture": _damaged_texture,
    "a strange file": _strange_file,
}
MODEL_DAMAGES = (*EDITS, "an encoding", *FILE_DAMAGES)


def model_case(number: int) -> Case:
    """Case number n: a damage by turns, of an MJCF, of a URDF or of mimic's Panda."""
    rng = np.random.default_rng([SEED, number])
    name = MODEL_DAMAGES[number % len(MODEL_DAMAGES)]
    kind = _pick(rng, ["xml", "xml", "urdf", "panda"])
    suffix = "urdf" if kind == "urdf" else "xml"

    def write(folder: Path) -> None:
        text = {"xml": _mjcf, "urdf": _urdf, "panda": _panda}[kind]()
        model = _write_files(folder) / f"model.{suffix}"
        model.write_text(text)
        if name in EDITS:
            model.write_text(EDITS[name](text, rng).replace("{0}", str(folder / "outside.xml")), errors="replace")
            if name == "links and limits" and kind == "xml":
                (model.parent / "parts.xml").write_text(_links(_PARTS, rng) if rng.integers(4) == 0 else _PARTS)
        elif name in FILE_DAMAGES:
            FILE_DAMAGES[name](model.parent, rng)
        else:
            model.write_bytes(_encoded(text, rng))

    return Case(name, write, lambda folder: _read(folder / _FOLDER / f"model.{suffix}"))


def _write_files(folder: Path) -> Path:
    """A model's folder with its files, and files around it that no model may read."""
    arm = folder / _FOLDER
    (arm / "meshes").mkdir(parents=True)
    (arm / "folder").mkdir()
    (folder / "outside.xml").write_text(_OUTSIDE)
    (folder / "outside.obj").write_text(_TETRAHEDRON)
    (arm / "parts.xml").write_text(_PARTS)
    (arm / "deep.xml").write_text('<mujoco><include file="../outside.xml"/></mujoco>')
    (arm / "other.xml").write_text('<mujoco><worldbody><body name="b"><geom size="0.1"/></body></worldbody></mujoco>')
    (arm / "meshes" / "tool.obj").write_text(_TETRAHEDRON)
    (arm / "grid.png").write_bytes(_png(4, 4, 4))
    (arm / "link.xml").symlink_to(folder / "outside.xml")
    (arm / "link.obj").symlink_to(folder / "outside.obj")
    (arm / "loop.xml").symlink_to("loop.xml")
    os.mkfifo(arm / "pipe")
    return arm


def _read(file: Path) -> str:
    """Builds the arm. Its numbers must be finite, and those that MuJoCo itself reads from the file."""
    arm = build_arm(ArmConfig(model=str(file)), limits="hardware")
    values = vars(arm.embodiment).values()
    arrays = [value for value in values if isinstance(value, np.ndarray) and value.dtype.kind == "f"]
    unlimited = arm.embodiment.torque_limit, arm.embodiment.velocity_limit
    if not all(np.all(np.isfinite(array)) for array in arrays if not any(array is limit for limit in unlimited)):
        return OTHER_NUMBERS
    if any(np.any(np.isnan(limit)) for limit in unlimited):
        return OTHER_NUMBERS
    model = read_model(file)
    if mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_BODY, _SECRET) >= 0:
        return OTHER_NUMBERS
    return ACCEPTED if _as_in_mujoco(file, model) else OTHER_NUMBERS


_COMPARED = ("body_mass", "body_inertia", "body_pos", "body_ipos", "body_quat", "jnt_type", "jnt_pos", "jnt_axis",
             "jnt_range",
             "dof_damping", "dof_armature", "actuator_ctrlrange", "actuator_gear", "site_pos", "qpos0", "key_qpos",
             "jnt_actfrcrange", "mesh_vert", "tex_data", "hfield_data")  # fmt: skip


def _as_in_mujoco(file: Path, model: mujoco.MjModel) -> bool:
    """Whether the model is the one that MuJoCo reads; True if MuJoCo alone rejects the file, or would miss meshes."""
    if read_source(file).missing:  # MuJoCo would wait for a pipe among them
        return True
    try:
        spec = mujoco.MjSpec.from_file(str(file))
        spec.compiler.fusestatic = spec.compiler.fusestatic and file.suffix == ".xml"
        other = spec.compile()
    except (ValueError, mujoco.FatalError):
        return True
    return all(np.array_equal(getattr(model, name), getattr(other, name)) for name in _COMPARED)


def _pick(rng: Generator, values: list[Any]) -> Any:
    return values[int(rng.integers(len(values)))]
