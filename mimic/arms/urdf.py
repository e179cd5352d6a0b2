"""Mends what MuJoCo rejects or misreads in a URDF: shapes without a size, unphysical inertia, and limits of joints.

Kinematics needs none of it, so that a file loads without. Each change is a line that names the links or joints.
"""

import math
import re
from collections.abc import Iterable, Iterator, Sequence
from xml.etree import ElementTree

import numpy as np

from mimic.arms.compile_check import MAX_VALUES, MAX_VELOCITY

_Element = ElementTree.Element
_MOVING = ("revolute", "continuous", "prismatic", "planar", "floating")
_MOMENTS = "ixx", "ixy", "ixz", "iyy", "iyz", "izz"
_FLAT = 1e-10  # of the trace of a second moment: the smallest principal value of a body that MuJoCo takes as physical
# What each principal value of a corrected body has at least: of the trace, so that rounding leaves it physical; and
# [kg m^2], as MuJoCo rejects inertias below 1e-14.
_THIN, _SMALLEST = 1e-6, 1e-13
_NOTICED, _NOTICED_INERTIA = 1e-5, 1e-9  # corrections from which a line says so: of the trace; kg m^2
_POINT_RADIUS = 1e-3  # m, radius of gyration of a body with a mass and no inertia
# A link that moves and states no inertia. Without gravity, torques scale with the mass of the whole arm.
_ASSUMED_MASS, _ASSUMED_LIGHT, _ASSUMED_RADIUS = 1.0, 1e-3, 0.1  # kg; where others have a mass; m
# Geometries by their sizes, with as many numbers as they have.
_SIZES = {"box": {"size": 3}, "sphere": {"radius": 1}, "cylinder": {"radius": 1, "length": 1}, "mesh": {},
          "capsule": {"radius": 1, "length": 1}}  # fmt: skip
_MAX_MASS, _MAX_INERTIA = MAX_VALUES["mass [kg]"][0], MAX_VALUES["inertia [kg m^2]"][0]
_MAX_RANGE, _MAX_TORQUE = MAX_VALUES["joint range [rad or m]"][0], MAX_VALUES["torque limit [N m]"][0]
_MANY_TURNS = 50.0  # rad: ranges that are stated in degrees are beyond it, those of winches and wheels too
_MAX_NAMES = 6  # in a line
_EXPRESSION = re.compile(r"\$[{(]")
_TEMPLATES = {"include", "macro", "property", "arg", "if", "unless"}  # elements of xacro that make a file a template


def is_xacro(root: _Element) -> bool:
    """Whether a URDF is a template; calls of macros that an expanded file still has are nothing of a robot."""
    names = {element.tag.partition("}")[2] for element in root.iter() if "xacro" in element.tag.partition("}")[0]}
    parts = (part for tag in ("link", "joint") for element in root.findall(tag) for part in element.iter())
    has_expressions = any(_EXPRESSION.search(value) for part in parts for value in part.attrib.values())
    return has_expressions or bool(names & _TEMPLATES) or bool(names and root.find("joint") is None)


def mend_urdf(root: _Element) -> tuple[str, ...]:
    """Changes a URDF so that MuJoCo reads it as it is meant.

    Returns:
      A line for each kind of change.

    Raises:
      ValueError: two links or joints of one name, or a number that is none. The message names the element.
    """
    for tag in ("link", "joint"):
        names = [element.get("name", "") for element in root.findall(tag)]
        duplicates = sorted({name for name in names if names.count(name) > 1})
        if duplicates:
            raise ValueError(f"two {tag}s are called {duplicates[0]!r}; expected one name each")
    stated_velocities(root)
    links = root.findall("link")
    empty = [link.get("name", "") for link in links if _drop_empty_shapes(link)]
    for joint in root.findall("joint"):
        _drop_torque_limit(joint)
        for axis in (axis for axis in joint.findall("axis") if "xyz" not in axis.attrib):
            joint.remove(axis)  # URDF's default is that of MuJoCo
    massless = [link.get("name", "") for link in links if _drop_mass(link)]
    corrected = [link.get("name", "") for link in links if _correct_inertia(link)]
    lines = {
        "ignored the shapes without a size of {}": empty,
        "ignored the inertia of {}, whose mass no body has": massless,
        "corrected the inertia of {}, which no body has, to the nearest physical one": corrected,
        **_assume_inertia(root),
        **_mend_limits(root.findall("joint")),
    }
    return tuple(line.format(_listed(names)) for line, names in lines.items() if names)


def stated_velocities(root: _Element) -> dict[str, float]:
    """The velocity limit of each joint of a URDF by name; inf where it states none, or one that is not above 0.

    Raises:
      ValueError: a limit that is no number.
    """
    limits = {}
    for joint in root.findall("joint"):
        limit, name = joint.find("limit"), joint.get("name", "")
        value = _number(limit, "velocity", f"the velocity limit of joint {name!r}") if limit is not None else 0.0
        limits[name] = value if 0 < value <= MAX_VELOCITY else math.inf
    return limits


def _listed(names: Sequence[str]) -> str:
    more = f" and {len(names) - _MAX_NAMES} more" if len(names) > _MAX_NAMES else ""
    return ", ".join(names[:_MAX_NAMES]) + more


def _number(element: _Element, attribute: str, what: str, nan: float | None = None) -> float:
    """An attribute, 0 where it is absent; `nan` stands for one that is not a number, else that is an error."""
    text = element.get(attribute, "0")
    try:
        value = float(text)
    except ValueError:
        raise ValueError(f"{what}: expected a number, got {text!r:.80}") from None
    if math.isnan(value) and nan is None:
        raise ValueError(f"{what}: expected a number, got {text!r:.80}")
    return value if nan is None or math.isfinite(value) else nan


# --- shapes and inertia -----------------------------------------------------------------------------------------------


def _drop_empty_shapes(link: _Element) -> bool:
    """Removes shapes without a size, a placeholder of some exporters; returns whether there were any."""
    shapes = [child for child in link if child.tag in ("visual", "collision")]
    empty = [shape for shape in shapes if not any(map(_has_size, shape.iterfind("geometry/*")))]
    for shape in shapes:
        shape.attrib.pop("name", None)  # MuJoCo warns of equal ones
    for shape in empty:
        link.remove(shape)
    return bool(empty)


def _has_size(geometry: _Element) -> bool:
    """Whether a geometry is one that MuJoCo reads, with a size."""
    counts = _SIZES.get(geometry.tag, {})
    scale = geometry.get("scale", "1 1 1")
    values = {name: [_size(x) for x in geometry.get(name, "").split()] for name in counts}
    is_scaled = len(scale.split()) == 3 and all(_size(x) for x in scale.split())
    return (
        bool(geometry.tag in _SIZES)
        and is_scaled
        and all(len(values[name]) == count and min(values[name]) > 0 for name, count in counts.items())
    )


def _size(text: str) -> float:
    try:
        return float(text)
    except ValueError:
        return 0.0


def _drop_mass(link: _Element) -> bool:
    """Makes a link without a mass above 0 a mere frame; returns whether it states an impossible mass."""
    inertial, mass = link.find("inertial"), _mass(link)
    if inertial is None or 0 < mass <= _MAX_MASS:
        return False
    _set_inertia(inertial, 0.0, np.zeros((3, 3)))
    return mass != 0


def _correct_inertia(link: _Element) -> bool:
    """Replaces an inertia that no body has by the nearest one of a body; returns whether it changes noticeably.

    A body's second moments of mass, tr(I)/2 - I, have no negative principal value (Wensing, Kim and Slotine 2018);
    negative ones are set to zero.
    """
    inertial, mass, inertia = link.find("inertial"), _mass(link), _inertia(link)
    if inertial is None or mass == 0:
        return False
    for element in inertial.findall("inertia"):
        element.attrib.update({name: "0" for name in _MOMENTS if name not in element.attrib})
    second = np.trace(inertia) / 2 * np.eye(3) - inertia
    values, axes = np.linalg.eigh(second)
    scale = max(float(np.abs(values).sum()), mass * _POINT_RADIUS**2)
    if values[0] >= _FLAT * scale and values[0] + values[1] >= _SMALLEST:
        return False
    is_point = not np.any(values > _FLAT * scale)
    smallest = mass * _POINT_RADIUS**2 / 3 if is_point else _THIN * scale
    values = np.maximum(values, max(smallest, _SMALLEST))
    second = (axes * values) @ axes.T
    physical = np.trace(second) * np.eye(3) - second
    _set_inertia(inertial, mass, physical)
    return bool(np.abs(physical - inertia).max() > max(_NOTICED * scale, _NOTICED_INERTIA))


def _mass(link: _Element) -> float:
    mass = link.find("inertial/mass")
    return 0.0 if mass is None else _number(mass, "value", f"the mass of link {link.get('name', '')!r}", nan=-1.0)


def _inertia(link: _Element) -> np.ndarray:
    element, what = link.find("inertial/inertia"), f"the inertia of link {link.get('name', '')!r}"
    if element is None:
        return np.zeros((3, 3))
    xx, xy, xz, yy, yz, zz = (_number(element, name, what, nan=math.inf) for name in _MOMENTS)
    inertia = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
    return inertia if np.all(np.abs(inertia) <= _MAX_INERTIA) else np.zeros((3, 3))


def _set_inertia(inertial: _Element, mass: float, inertia: np.ndarray) -> None:
    for tag in ("mass", "inertia"):
        for element in inertial.findall(tag):
            inertial.remove(element)
    ElementTree.SubElement(inertial, "mass", value=repr(float(mass)))
    rows, columns = (0, 0, 0, 1, 1, 2), (0, 1, 2, 1, 2, 2)
    values = dict(zip(_MOMENTS, inertia[rows, columns].tolist(), strict=True))
    ElementTree.SubElement(inertial, "inertia", {name: repr(value) for name, value in values.items()})


def _assume_inertia(root: _Element) -> dict[str, list[str]]:
    """Gives an inertia to the links that a joint moves, if neither they nor what is fixed to them have a mass."""
    links = {link.get("name", ""): link for link in root.findall("link")}
    fixed: dict[str, list[str]] = {}
    moved: list[str] = []
    for joint in root.findall("joint"):
        parent, child = _end(joint, "parent"), _end(joint, "child")
        if joint.get("type") in _MOVING:
            moved.append(child)
        else:
            fixed.setdefault(parent, []).append(child)
    light = [name for name in moved if name in links and not any(_has_mass(links[x]) for x in _welded(name, fixed))]
    light = [name for name in light if all(name in links for name in _welded(name, fixed))]
    mass = _ASSUMED_LIGHT if any(_has_mass(link) for link in links.values()) else _ASSUMED_MASS
    for name in light:
        for inertial in links[name].findall("inertial"):
            links[name].remove(inertial)
        inertial = ElementTree.SubElement(links[name], "inertial")
        _set_inertia(inertial, mass, 0.4 * mass * _ASSUMED_RADIUS**2 * np.eye(3))
    line = f"no <inertial> with a mass in {{}}: a ball of {mass:g} kg and {_ASSUMED_RADIUS:g} m radius is assumed"
    return {line: light}


def _end(joint: _Element, tag: str) -> str:
    element = joint.find(tag)
    return "" if element is None else element.get("link", "")


def _welded(link: str, fixed: dict[str, list[str]]) -> Iterator[str]:
    """A link and those that are fixed to it; each once, also where joints form a circle."""
    pending, known = [link], {link}
    while pending:
        yield (name := pending.pop())
        added = [child for child in fixed.get(name, []) if child not in known]
        pending += added
        known.update(added)


def _has_mass(link: _Element) -> bool:
    """Whether a link states a mass, or has a shape from which MuJoCo computes one."""
    return _mass(link) > 0 if link.find("inertial") is not None else link.find("collision") is not None


# --- limits of joints -------------------------------------------------------------------------------------------------


def _mend_limits(joints: Iterable[_Element]) -> dict[str, list[str]]:
    """Writes ranges that MuJoCo keeps, and removes torque limits that are none."""
    swapped = "lower limit above the upper one in {}: swapped"
    none = "no range of angles in {}: a full turn is assumed"
    one_sided = "one limit alone is stated in {}: 0 is the other one, as URDF defines it"
    wide = f"limits beyond {_MANY_TURNS:g} in {{}}: read as rad, as URDF defines them, and not as degrees"
    changed: dict[str, list[str]] = {swapped: [], none: [], one_sided: [], wide: []}
    for joint in (joint for joint in joints if joint.get("type") in ("revolute", "prismatic")):
        name, limit = joint.get("name", ""), joint.find("limit")
        if limit is None:
            limit = ElementTree.SubElement(joint, "limit")
        ends = [_number(limit, end, f"the {end} limit of joint {name!r}") for end in ("lower", "upper")]
        is_one_sided = ("lower" in limit.attrib) != ("upper" in limit.attrib)
        if ends[0] == ends[1] or max(map(abs, ends)) > _MAX_RANGE:
            for end in ("lower", "upper"):
                limit.attrib.pop(end, None)
            if joint.get("type") == "revolute":
                joint.set("type", "continuous")
                changed[none].append(name)
            continue
        if joint.get("type") == "revolute" and max(map(abs, ends)) > _MANY_TURNS:
            changed[wide].append(name)
        if is_one_sided or ends[0] > ends[1]:
            limit.set("lower", repr(min(ends)))
            limit.set("upper", repr(max(ends)))
        if is_one_sided:
            changed[one_sided].append(name)
        elif ends[0] > ends[1]:
            changed[swapped].append(name)
    return changed


def _drop_torque_limit(joint: _Element) -> None:
    """Removes a torque limit that is none: MuJoCo takes -1 as 1 N m."""
    limit = joint.find("limit")
    if limit is not None and "effort" in limit.attrib:
        effort = _number(limit, "effort", f"the effort limit of joint {joint.get('name', '')!r}")
        if not 0 < effort <= _MAX_TORQUE:
            del limit.attrib["effort"]
