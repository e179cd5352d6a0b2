"""The hand frame that mimic finds for each of some arms, as a table and as a picture to look at.

    python -m benchmarks.hands NAME=FILE [NAME=FILE ...] [--picture sheet.png] [--out FILE]

NAME is the title; FILE an MJCF or URDF file, with @TIP after it for a file with several arms, or a packaged arm. Each
picture looks across the plane in which the gripper opens, so that a fork that stands askew to the fingers is seen.
"""

import argparse
import logging
from collections.abc import Sequence
from pathlib import Path

import mujoco
import numpy as np

from benchmarks.common.parser import make_parser
from benchmarks.common.record import Row, failure, print_table, write_results
from benchmarks.figures.canvas import plt, save
from mimic.arms.arm import ArmConfig, build_arm
from mimic.arms.link_match import hand_poses
from mimic.arms.rendering import new_renderer
from mimic.arms.visual_model import visual_spec

COLUMNS = "arm joints approach opening reason doubt"
_PIXELS, _COLUMNS = 300, 6
_DISTANCE, _BEHIND, _TILT = 0.5, 0.04, 0.4  # chain lengths, chain lengths, and the view's tilt off the plane


def config_of(argument: str) -> tuple[str, ArmConfig]:
    """Name and arm of an argument NAME=FILE@TIP, of which FILE alone is needed."""
    name, _, file = argument.rpartition("=")
    model, _, tip = file.partition("@")
    return name or Path(model).stem, ArmConfig(model=model, tip=tip or None)


def describe(name: str, config: ArmConfig) -> Row:
    """The hand of an arm in words and numbers, in the base frame of the zero pose [m]."""
    arm = build_arm(config)
    (end,), pose = arm.ends, hand_poses(arm.embodiment, np.zeros(arm.embodiment.num_joints))[0].round(4) + 0.0
    axes = {key: pose[:3, column].tolist() for key, column in (("approach", 2), ("opening", 0), ("position", 3))}
    return {"arm": name, "joints": arm.embodiment.num_joints, **axes, "reason": end.reason, "doubt": end.doubt}


def picture(config: ArmConfig) -> np.ndarray:
    """An image [_PIXELS, _PIXELS, 3] of the hand at the arm's home pose."""
    arm = build_arm(config, "hardware").embodiment
    spec, T_world_base = visual_spec(config, "hardware")
    spec.add_texture(
        name="white", type=mujoco.mjtTexture.mjTEXTURE_SKYBOX, builtin=mujoco.mjtBuiltin.mjBUILTIN_FLAT,
        rgb1=[1, 1, 1], rgb2=[1, 1, 1], width=8, height=8,
    )  # fmt: skip
    spec.worldbody.add_light(pos=[2, -2, 4], dir=[-2, 2, -4], type=mujoco.mjtLightType.mjLIGHT_DIRECTIONAL)
    model = spec.compile()
    model.vis.headlight.ambient[:], model.vis.headlight.diffuse[:] = 0.5, 0.5
    model.vis.map.znear = 1e-4
    data = mujoco.MjData(model)
    for joint, angle in zip(arm.joint_names, arm.home, strict=True):
        data.joint(joint).qpos[0] = angle
    mujoco.mj_forward(model, data)
    pose, length = T_world_base @ hand_poses(arm, arm.home)[0], float(arm.chain_length)
    away = -np.sign(pose[:3, 1] @ (pose[:3, 3] - T_world_base[:3, 3])) or 1.0  # the arm is behind its hand
    camera, view = mujoco.MjvCamera(), pose[:3, :3] @ [-_TILT, away, _TILT]
    camera.lookat[:] = pose[:3, 3] - _BEHIND * length * pose[:3, 2]
    camera.distance = _DISTANCE * length
    camera.azimuth = np.degrees(np.arctan2(view[1], view[0]))
    camera.elevation = np.degrees(np.arctan2(view[2], np.hypot(view[0], view[1])))
    renderer, option = new_renderer(model, _PIXELS, _PIXELS), mujoco.MjvOption()
    option.sitegroup[:] = 0
    with renderer:
        renderer.update_scene(data, camera, option)
        return renderer.render()


def save_sheet(arms: Sequence[tuple[str, ArmConfig]], path: Path) -> None:
    """Saves the pictures of all arms side by side."""
    rows = -(-len(arms) // _COLUMNS)
    figure, axes = plt.subplots(rows, _COLUMNS, figsize=(2 * _COLUMNS, 2.2 * rows), layout="constrained", squeeze=False)
    for axis in axes.flat:
        axis.axis("off")
    for axis, (name, config) in zip(axes.flat, arms, strict=False):
        axis.imshow(picture(config))
        axis.set_title(name, fontsize=8)
    save(figure, path)


def main(arguments: Sequence[str] | None = None) -> None:
    parser = make_parser("hands", __doc__)
    parser.add_argument("arms", nargs="+", type=config_of, metavar="NAME=FILE")
    parser.add_argument("--picture", type=Path, metavar="PNG", help="an image of each hand")
    options: argparse.Namespace = parser.parse_args(arguments)
    logging.getLogger("mimic").setLevel(logging.ERROR)
    rows: list[Row] = []
    readable = []
    for name, config in options.arms:
        try:
            rows.append(describe(name, config))
            readable.append((name, config))
        except ValueError as error:
            rows.append({"arm": name, **failure(error)})
    print_table(rows, COLUMNS)
    write_results(options, hands=rows)
    if options.picture:
        save_sheet(readable, options.picture)


if __name__ == "__main__":
    main()
