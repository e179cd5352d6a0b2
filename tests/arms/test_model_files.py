"""Arms from files: kinematics and dynamics equal those of the original model in C MuJoCo."""

import jax
import mujoco
import numpy as np
import pytest

import mimic
from mimic.arms.arm import ArmConfig, build_arm
from mimic.arms.model_files import read_model, read_spec
from mimic.arms.model_source import MAX_FILE_SIZE
from tests.helpers import original_model, random_arms

POSES = 10
# Arms that others wrote, in packages that need not be installed: their paths there, and where the last link ends.
OTHERS = {
    "Panda": ("robosuite/models/assets/robots/panda/robot.xml", "right_hand"),
    "UR5e": ("robosuite/models/assets/robots/ur5e/robot.xml", "right_hand"),
    "IIWA": ("robosuite/models/assets/robots/iiwa/robot.xml", "right_hand"),
    "Kinova3": ("robosuite/models/assets/robots/kinova3/robot.xml", "right_hand"),
    "Sawyer": ("robosuite/models/assets/robots/sawyer/robot.xml", "right_hand"),
    "Jaco": ("robosuite/models/assets/robots/jaco/robot.xml", "right_hand"),
    "Fetch": ("gymnasium_robotics/envs/assets/fetch/reach.xml", "robot0:grip"),
    "Franka with hand, URDF": (
        "robosuite/models/assets/bullet_data/panda_description/urdf/panda_arm_hand.urdf",
        "panda_hand",
    ),
}


def other(name):
    """The file of a third-party arm, and its tip."""
    path, tip = OTHERS[name]
    return original_model.package_file(path), tip


def largest_errors(file, original, tip, base=None):
    """Maximum errors of link states, and of the mass matrix and bias forces, over random poses and velocities."""
    arm = build_arm(ArmConfig(model=str(file), tip=tip, base=base))
    embodiment, simulated = arm.embodiment, mujoco.MjData(arm.model)
    qpos_at, qvel_at = original_model.addresses(original, embodiment.joint_names)
    original.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_GRAVITY)
    states = jax.jit(lambda qpos, qvel: mimic.link_states(embodiment, qpos, qvel, normalized=False))
    rng, kinematic, dynamic = np.random.default_rng(0), 0.0, 0.0
    for _ in range(POSES):
        qpos, qvel = rng.uniform(-np.pi, np.pi, len(qpos_at)), rng.normal(size=len(qpos_at))
        data = mujoco.MjData(original)
        data.qpos[:] = original_model.at_rest(original)
        data.qpos[qpos_at], data.qvel[qvel_at] = qpos, qvel
        mujoco.mj_forward(original, data)
        found = states(qpos, qvel)
        names = embodiment.link_names, embodiment.joint_names
        for key, value in random_arms.links(original, data, *names, tip).items():
            kinematic = max(kinematic, float(np.abs(np.asarray(getattr(found, key)) - value).max()))
        simulated.qpos[:], simulated.qvel[:] = qpos, qvel
        mujoco.mj_forward(arm.model, simulated)
        masses = np.zeros((original.nv, original.nv)), np.zeros((arm.model.nv, arm.model.nv))
        for model, state, mass in ((original, data, masses[0]), (arm.model, simulated, masses[1])):
            mujoco.mj_fullM(model, state, mass)
        scale = np.abs(masses[1]).max()
        dynamic = max(dynamic, float(np.abs(masses[0][np.ix_(qvel_at, qvel_at)] - masses[1]).max() / scale))
        dynamic = max(dynamic, float(np.abs(data.qfrc_bias[qvel_at] - simulated.qfrc_bias).max() / scale))
    return kinematic, dynamic


@pytest.mark.parametrize("name", OTHERS)
def test_third_party_arms_move_as_in_their_models(x64, name):
    file, tip = other(name)
    # MuJoCo does not look up the meshes that a URDF names by their ROS package.
    original = read_model(file) if name.endswith("URDF") else mujoco.MjModel.from_xml_path(str(file))
    kinematic, dynamic = largest_errors(file, original, tip)
    print(f"{name}: link states off by {kinematic:.1e}, dynamics by {dynamic:.1e}")
    swing = 2e-5 if name == "Kinova3" else 0.0  # m; its file rounds the first axis, about which its base link rotates
    assert kinematic < 1e-9 + swing and dynamic < 1e-9


@pytest.mark.parametrize(("actuators", "tip"), [("motor", "pinch"), ("position", "palm"), ("none", "wrist_3_link")])
def test_a_generated_arm_moves_as_in_its_model(x64, tmp_path, actuators, tip):
    file = original_model.ur_file(tmp_path, actuators=actuators)
    kinematic, dynamic = largest_errors(file, mujoco.MjModel.from_xml_path(str(file)), tip)
    assert kinematic < 1e-9 and dynamic < 1e-9


def test_a_urdf_arm_moves_as_in_its_model(x64, tmp_path):
    file = tmp_path / "arm.urdf"
    file.write_text(original_model.urdf())
    spec = mujoco.MjSpec.from_file(str(file))
    spec.compiler.fusestatic = False  # else the tool has no name
    kinematic, dynamic = largest_errors(file, spec.compile(), "tool")
    assert kinematic < 1e-9 and dynamic < 1e-9
    arm = mimic.load_mjcf(file)
    assert arm.name == "four" and arm.torque_limit.tolist() == [39, 38, 37, 36]
    assert arm.velocity_limit.tolist() == [0.5, 1, 1.5, 2]
    file.write_text(original_model.urdf().replace('velocity="0.5"', 'velocity="0"'))
    assert mimic.load_mjcf(file).velocity_limit.tolist() == [np.inf, 1, 1.5, 2]
    assert arm.link_lengths[-1] == pytest.approx(0.15)


def test_servos_and_motors_give_the_same_arm(tmp_path):
    arms = []
    for actuators in ("motor", "position"):
        file = original_model.ur_file(tmp_path, actuators=actuators)
        arms.append(build_arm(ArmConfig(model=str(file))))
    motor, servo = arms
    np.testing.assert_array_equal(motor.embodiment.torque_limit, servo.embodiment.torque_limit)
    assert motor.model.nu == servo.model.nu == 0
    np.testing.assert_array_equal(motor.model.dof_damping, servo.model.dof_damping)
    assert any("6 servos on position" in note for note in servo.notes)
    assert any("left (slide), right (slide)" in note for note in servo.notes)


def test_unnamed_joints_are_named_and_can_be_simulated(tmp_path):
    file = original_model.ur_file(tmp_path, named=False, gripper="")
    arm = build_arm(ArmConfig(model=str(file), locked=["joint2"]))
    assert arm.embodiment.joint_names == ("joint1", "joint3", "joint4", "joint5", "joint6")
    assert arm.model.nq == 5
    assert [joint.name for joint in read_spec(file).joints] == [f"joint{number}" for number in range(1, 7)]


def test_rotor_inertia_and_damping_are_at_least_the_configured_ones(tmp_path):
    file = original_model.ur_file(tmp_path, armature=0.02)
    model = build_arm(ArmConfig(model=str(file), armature=0.1, damping=0.1)).model
    assert model.dof_armature.tolist() == [0.1] * 6 and model.dof_damping.tolist() == [0.2] * 6


def test_a_model_is_found_from_any_folder(tmp_path, monkeypatch):
    (tmp_path / "arm.xml").write_text(original_model.ur_like())
    monkeypatch.chdir(tmp_path)
    assert ArmConfig(model="arm.xml").model == str(tmp_path / "arm.xml")
    assert mimic.env_config("pair", learner="arm.xml").learner.model == str(tmp_path / "arm.xml")


# --- bad files --------------------------------------------------------------------------------------------------------

LAUGHS = "".join(f'<!ENTITY l{i} "{f"&l{i - 1};" * 10}">' for i in range(1, 10))
BOMB = f'<?xml version="1.0"?><!DOCTYPE m [<!ENTITY l0 "ha">{LAUGHS}]><mujoco model="&l9;"/>'
FILES = {
    "missing": (None, "no MJCF or URDF file at '.*arm.xml'$"),
    "not xml": ("joint1 = 3", "'.*arm.xml' is not an MJCF or URDF model that MuJoCo can read: "),
    "an entity bomb": (BOMB, "'.*arm.xml' declares a document type or entities; expected plain MJCF or URDF$"),
    "a missing mesh": (
        '<mujoco><asset><mesh name="a" file="a.stl"/></asset>'
        '<worldbody><geom type="mesh" mesh="a"/></worldbody></mujoco>',
        "'.*arm.xml' needs the file 'a.stl', which does not exist; expected all its files next to it$",
    ),
    "no inertia": (
        "<mujoco><worldbody><body><joint/></body></worldbody></mujoco>",
        "'.*arm.xml' has a moving body without inertia; expected an <inertial>",
    ),
    "huge": (
        " " * (MAX_FILE_SIZE + 1),
        "'.*arm.xml' cannot be read: expected at most 8,388,608 bytes, got 8,388,609$",
    ),
    "a broken URDF": ('<robot name="a"><link name="b"></robot>', "'.*arm.xml' is not an MJCF or URDF model"),
}


@pytest.mark.parametrize("case", FILES)
def test_bad_files_are_rejected(tmp_path, case):
    content, message = FILES[case]
    file = tmp_path / "arm.xml"
    if content is not None:
        file.write_text(content)
    with pytest.raises(ValueError, match=f"^{message}") as error:
        mimic.load_mjcf(file)
    assert "\n" not in str(error.value)
