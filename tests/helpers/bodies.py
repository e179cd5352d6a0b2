"""A person whose arms move, as points and as files of motion capture; generated, so that all is known."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from mimic.motions.mocap.points import PointMotion

# Name, parent and offset [m] of each joint at rest, y up, facing z, as many BVH files are.
JOINTS = (
    ("Hips", -1, (0.0, 0.95, 0.0)),
    ("Spine", 0, (0.0, 0.25, 0.0)),
    ("Head", 1, (0.0, 0.45, 0.0)),
    ("LeftShoulder", 1, (0.03, 0.2, 0.0)),
    ("LeftArm", 3, (0.15, 0.0, 0.0)),
    ("LeftForeArm", 4, (0.28, 0.0, 0.0)),
    ("LeftHand", 5, (0.25, 0.0, 0.0)),
    ("LeftHandThumb", 6, (0.02, 0.0, 0.04)),
    ("LeftHandMiddle1", 6, (0.09, 0.0, 0.0)),
    ("RightShoulder", 1, (-0.03, 0.2, 0.0)),
    ("RightArm", 9, (-0.15, 0.0, 0.0)),
    ("RightForeArm", 10, (-0.28, 0.0, 0.0)),
    ("RightHand", 11, (-0.25, 0.0, 0.0)),
    ("RightHandMiddle1", 12, (-0.09, 0.0, 0.0)),
    ("LeftUpLeg", 0, (0.1, -0.05, 0.0)),
    ("LeftFoot", 14, (0.0, -0.85, 0.0)),
    ("RightUpLeg", 0, (-0.1, -0.05, 0.0)),
    ("RightFoot", 16, (0.0, -0.85, 0.0)),
)
ARMS = {"left": ("LeftArm", "LeftForeArm", "LeftHand"), "right": ("RightArm", "RightForeArm", "RightHand")}
RATE = 60.0


def angles(samples: int = 600, seed: int = 0) -> dict[str, np.ndarray]:
    """Rotations about z, x, y [deg] of the joints of both arms, [samples, 3] each; smooth, below 1.5 Hz."""
    rng, time = np.random.default_rng(seed), np.arange(samples) / RATE
    waves = {}
    for name in (name for arm in ARMS.values() for name in arm):
        frequency, phase = rng.uniform(0.2, 1.0, 3), rng.uniform(0, 6, 3)
        waves[name] = 35 * np.sin(2 * np.pi * frequency * time[:, None] + phase)
    return waves


def bvh_text(samples: int = 600, *, unit: float = 0.01, turns: bool = False, frames: int | None = None) -> str:
    """The person as a BVH file, with lengths in a unit [m]; `turns` adds a full turn to angles here and there."""
    waves = angles(samples)
    children = {i: [j for j, joint in enumerate(JOINTS) if joint[1] == i] for i in range(-1, len(JOINTS))}
    columns = []

    def joint(index: int, depth: int) -> str:
        name, _, offset = JOINTS[index]
        scaled = np.array(offset) / unit
        moving = waves.get(name, np.zeros((samples, 3)))
        if turns:
            moving = moving + 360.0 * (np.arange(samples)[:, None] % 50 > 25)
        position = np.tile(scaled, (samples, 1)) if index == 0 else np.empty((samples, 0))
        own = np.concatenate([position, moving], axis=1)
        columns.append(own)
        names = ("Xposition Yposition Zposition " if index == 0 else "") + "Zrotation Xrotation Yrotation"
        indent = "\t" * depth
        inner = "".join(joint(child, depth + 1) for child in children[index])
        if not inner:
            inner = f"{indent}\tEnd Site\n{indent}\t{{\n{indent}\t\tOFFSET 0 0 0\n{indent}\t}}\n"
        return (
            f"{indent}{'JOINT' if index else 'ROOT'} {name}\n{indent}{{\n"
            f"{indent}\tOFFSET {' '.join(f'{value:.12g}' for value in scaled)}\n"
            f"{indent}\tCHANNELS {own.shape[1]} {names}\n{inner}{indent}}}\n"
        )

    head = f"HIERARCHY\n{joint(0, 0)}"
    values = np.concatenate(columns, axis=1)
    rows = "\n".join(" ".join(f"{value:.9f}" for value in row) for row in values)
    return f"{head}MOTION\nFrames: {frames or samples}\nFrame Time: {1 / RATE:.9f}\n{rows}\n"


def positions(samples: int = 600) -> np.ndarray:
    """Positions of the joints [samples, joints, 3] [m], z up, x left of the person... by a recursion of its own."""
    from scipy.spatial.transform import Rotation

    waves = angles(samples)
    frames: list[tuple[Rotation, np.ndarray]] = []
    for name, parent, offset in JOINTS:
        turn = Rotation.from_euler("ZXY", waves.get(name, np.zeros((samples, 3))), degrees=True)
        at_base = Rotation.identity(samples), np.zeros((samples, 3))
        rotation, place = frames[parent] if parent >= 0 else at_base
        frames.append((rotation * turn, place + rotation.apply(offset)))
    result = np.stack([place for _, place in frames], axis=1)
    return result[..., [2, 0, 1]]  # z x y: y up becomes z up


def person(samples: int = 600) -> PointMotion:
    """The person's joints, as a reader gives them."""
    names, parents, _ = zip(*JOINTS, strict=True)
    return PointMotion(names, parents, positions(samples), RATE)


def write_npz(path: Path, names: Sequence[str], positions: np.ndarray, **content: Any) -> Path:
    """Writes points at the rate of the person, or at the times or the rate in `content`."""
    rate = {} if "time" in content else {"rate": RATE}
    np.savez(path, names=np.array(names), positions=positions, **{**rate, **content})
    return path


def write_trc(
    path: Path, motion: PointMotion, *, time: np.ndarray | None = None, rate: float = RATE, separator: str = "\t"
) -> Path:
    """Writes a TRC file in mm; points that were not seen are empty."""
    order = [1, 2, 0]  # y up
    time = np.arange(len(motion.positions)) / motion.rate if time is None else time
    lines = [
        ["PathFileType", "4", "(X/Y/Z)", path.name],
        ["DataRate", "CameraRate", "NumFrames", "NumMarkers", "Units"],
        [f"{rate}", f"{rate}", f"{len(time)}", f"{len(motion.names)}", "mm"],
        ["Frame#", "Time", *(cell for name in motion.names for cell in (name, "", ""))],
        [""] * (2 + 3 * len(motion.names)),
    ]
    for i, row in enumerate(1000 * motion.positions[..., order].reshape(len(time), -1)):
        lines.append([str(i + 1), f"{time[i]:.10g}", *("" if np.isnan(value) else f"{value:.6f}" for value in row)])
    path.write_text("\n".join(map(separator.join, lines)))
    return path


def write_c3d(path: Path, points: np.ndarray, **labels: list[str]) -> Path:
    """Writes points [samples, points, 3] [mm] as C3D, with lists of words of the group POINT."""
    ezc3d = pytest.importorskip("ezc3d", reason="the extra [mocap] is not installed")
    file = ezc3d.c3d()
    for key, value in {"UNITS": ["mm"], **labels}.items():
        file.add_parameter("POINT", key, value)
    file["parameters"]["POINT"]["RATE"]["value"] = [RATE]
    file["data"]["points"] = np.ones((4, points.shape[1], len(points)))
    file["data"]["points"][:3] = points.transpose(2, 1, 0)
    file.write(str(path))
    return path
