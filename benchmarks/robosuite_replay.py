"""Arms of robosuite as files, and motions replayed in its tasks; run by a Python that has robosuite and not mimic.

    PYTHON benchmarks/robosuite_replay.py models FOLDER      # an MJCF file of each arm, with the Panda's gripper
    PYTHON benchmarks/robosuite_replay.py replay JOBS OUT    # JSON files: a list of jobs, and of results

A job has `task`, `robot`, `demonstration` (a folder of a recording), `base` [x, y, z, yaw] in the Panda's base frame,
`motion` (a NumPy file of angles [time, joints]). The objects start where the recording has them, and the arm at the
first angles. robosuite's joint position control gets the angles of the next time, and its gripper the recorded command.
A result has, beside success, `hand_lag_mm` and `door_rad` at each time.
"""

import functools
import json
import os
import shutil
import sys
import xml.etree.ElementTree as ET
from pathlib import Path
from typing import Any

os.environ.setdefault("MUJOCO_GL", "egl")

import mujoco  # noqa: E402
import numpy as np  # noqa: E402
import robosuite  # noqa: E402  # pyright: ignore[reportMissingImports]
from robosuite.controllers import load_part_controller_config  # noqa: E402  # pyright: ignore[reportMissingImports]
from robosuite.controllers.composite.composite_controller_factory import (  # noqa: E402  # pyright: ignore[reportMissingImports]
    refactor_composite_controller_config,
)
from robosuite.models.grippers import gripper_factory  # noqa: E402  # pyright: ignore[reportMissingImports]
from robosuite.models.robots import create_robot  # noqa: E402  # pyright: ignore[reportMissingImports]

ROBOTS = {"panda": "Panda", "ur5e": "UR5e", "iiwa14": "IIWA", "gen3": "Kinova3", "jaco": "Jaco", "xarm7": "XArm7"}
TASKS = {"lift": "Lift", "stack": "Stack", "nut-assembly": "NutAssembly", "pick-place": "PickPlace", "door": "Door"}
_GRIPPER, _ARM = "PandaGripper", "right"
_STIFFNESS = 1000.0  # 1/s^2, of the joint control: a time constant of 0.03 s
_RATE = 20  # Hz, of the recordings
_PACKAGE = Path(str(robosuite.__file__)).parent


def write_models(folder: Path) -> None:
    """Writes FOLDER/NAME/NAME.xml with its meshes beside it."""
    for name, robot in ROBOTS.items():
        model = create_robot(robot, idn=0)
        model.add_gripper(gripper_factory(_GRIPPER, idn=f"0_{_ARM}"), model.eef_name[_ARM])
        root, own = ET.fromstring(model.get_xml()), folder / name
        own.mkdir(parents=True, exist_ok=True)
        for number, element in enumerate(root.iter()):
            if file := element.get("file"):
                copy = f"{number}{Path(file).suffix}"
                shutil.copyfile(file, own / copy)
                element.set("file", copy)
        (own / f"{name}.xml").write_text(ET.tostring(root, encoding="unicode"))


def recorded_meshes(demonstration: Path, xml: str) -> str:
    """A scene whose objects have the meshes and sizes of the recording, which another version made."""
    recorded = ET.parse(demonstration / "model_1.xml").getroot().iter("mesh")
    meshes = {mesh.get("name", ""): mesh for mesh in recorded if "/objects/" in mesh.get("file", "")}
    root = ET.fromstring(xml)
    for mesh in root.iter("mesh"):
        for name in filter(mesh.get("name", "").endswith, meshes):
            mesh.set("file", str(_PACKAGE.parent / meshes[name].get("file", "")))
            mesh.set("scale", meshes[name].get("scale", "1 1 1"))
    return ET.tostring(root, encoding="unicode")


def make_task(task: str, robot: str, demonstration: Path) -> Any:
    """A task with joint position control; nothing is drawn."""
    part = load_part_controller_config(default_controller="JOINT_POSITION")
    part |= {"input_type": "absolute", "kp": _STIFFNESS, "kp_limits": [0, 2 * _STIFFNESS]}
    env = robosuite.make(
        TASKS[task], robots=robot, gripper_types=_GRIPPER, base_types="NullMount", control_freq=_RATE,
        controller_configs=refactor_composite_controller_config(part, robot, [_ARM]), ignore_done=True,
        has_renderer=False, has_offscreen_renderer=False, use_camera_obs=False,
        **({"use_latch": True} if task == "door" else {}),
    )  # fmt: skip
    env.set_xml_processor(functools.partial(recorded_meshes, demonstration))
    env.reset()
    env.hard_reset = False
    return env


def place(env: Any, job: dict[str, Any], states: np.ndarray, qpos: np.ndarray) -> None:
    """Puts the objects where the recording has them, and the arm's base and joints where the job does."""
    model, data = env.sim.model._model, env.sim.data._data
    scene = ET.parse(Path(job["demonstration"]) / "model_1.xml").getroot().find("worldbody")
    assert scene is not None
    bodies = {body.get("name"): body for body in scene.findall("body")}
    origin = np.array(bodies["robot0_link0"].get("pos", "").split(), float)
    x, y, z, yaw = job["base"]
    base = model.body("robot0_base").id
    model.body_pos[base] = origin + [x, y, z]
    model.body_quat[base] = [np.cos(yaw / 2), 0, 0, np.sin(yaw / 2)]
    if "Door" in bodies:
        door = model.body("Door_main").id
        model.body_pos[door], model.body_quat[door] = (
            np.array(bodies["Door"].get(key, "").split(), float) for key in ("pos", "quat")
        )
    for name in ("cube", "cubeA", "cubeB"):
        if name in bodies:
            (shape,) = (geom for geom in bodies[name].findall("geom") if geom.get("contype") != "0")
            for geom in range(model.ngeom):
                if model.geom(geom).name.startswith(f"{name}_g0"):
                    model.geom_size[geom] = np.array(shape.get("size", "").split(), float)
    joints = len(env.robots[0]._ref_joint_pos_indexes)
    panda = 7
    data.qpos[:joints], data.qpos[joints:] = qpos, states[1 + panda : 1 + panda + model.nq - joints]
    data.qvel[:] = 0
    mujoco.mj_forward(model, data)


def objects_done(env: Any) -> str:
    """How many of several objects are where they belong."""
    for name in ("objects_on_pegs", "objects_in_bins"):
        if hasattr(env, name):
            return f"{int(np.sum(getattr(env, name)))} of {len(getattr(env, name))}"
    return ""


def replay(job: dict[str, Any], env: Any) -> dict[str, Any]:
    """Whether the task succeeds at the end, and how far the arm was from the angles that it should have had."""
    import h5py  # pyright: ignore[reportMissingImports]

    with h5py.File(Path(job["demonstration"]) / "demo.hdf5") as file:
        states, actions = file["data/demo_1/states"][()], file["data/demo_1/actions"][()]
    qpos = np.load(job["motion"])
    env.reset()
    place(env, job, states[0], qpos[0])
    for robot in env.robots:
        robot.composite_controller.update_state()
        robot.composite_controller.reset()
    joints, ever, error = qpos.shape[1], False, []
    lag, door = [], []
    for time, action in enumerate(actions):
        goal = qpos[min(time + 1, len(qpos) - 1)]
        env.step(np.concatenate([goal, action[-1:]]))
        ever = bool(env._check_success()) or ever
        error.append(np.abs(env.sim.data.qpos[:joints] - goal).max())
        lag.append(round(1e3 * hand_lag(env, goal), 2))
        if job["task"] == "door":
            door.append(round(float(env.sim.data._data.joint("Door_hinge").qpos[0]), 4))
    return {
        "success": bool(env._check_success()),
        "ever": ever,
        "objects": objects_done(env),
        "tracking_error_rad": float(np.max(error)),
        "hand_lag_mm": lag,
        "door_rad": door,
    }


def hand_lag(env: Any, goal: np.ndarray) -> float:
    """Distance [m] of the hand from where it would be at these joint angles."""
    model, data, site = env.sim.model._model, env.sim.data._data, "gripper0_right_grip_site"
    at_goal = mujoco.MjData(model)
    at_goal.qpos[:] = data.qpos
    at_goal.qpos[: len(goal)] = goal
    mujoco.mj_kinematics(model, at_goal)
    return float(np.linalg.norm(at_goal.site(site).xpos - data.site(site).xpos))


def main() -> None:
    if sys.argv[1] == "models":
        write_models(Path(sys.argv[2]))
        return
    results, made = [], {}
    for job in json.loads(Path(sys.argv[2]).read_text()):
        key = job["task"], ROBOTS[job["robot"]]
        if key not in made:
            made = {key: make_task(*key, Path(job["demonstration"]))}  # one at a time, for the memory
        results.append({**job, **replay(job, made[key])})
        Path(sys.argv[3]).write_text(json.dumps(results, indent=1))


if __name__ == "__main__":
    main()
