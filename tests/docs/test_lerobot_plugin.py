"""The example that drives LeRobot's arms, with a simulated SO-101-like leader and a UR-like follower; needs LeRobot."""

# pyright: reportMissingImports=false

import dataclasses
import importlib.util
import sys

import numpy as np
import pytest

import mimic
from mimic.arms.link_match import hand_poses
from tests.helpers import original_model, real_data
from tests.helpers.repository import REPOSITORY

if importlib.util.find_spec("lerobot") is None or importlib.util.find_spec("torch") is None:
    pytest.skip("needs lerobot", allow_module_level=True)
sys.path.append(str(REPOSITORY / "examples" / "lerobot_teleoperator_mimic"))

import lerobot_teleoperator_mimic as plugin  # noqa: E402
from lerobot.processor import RobotProcessorPipeline  # noqa: E402
from lerobot.processor.converters import (  # noqa: E402
    robot_action_observation_to_transition,
    transition_to_robot_action,
)
from lerobot.teleoperators.config import TeleoperatorConfig  # noqa: E402
from lerobot.teleoperators.teleoperator import Teleoperator  # noqa: E402
from lerobot.teleoperators.utils import make_teleoperator_from_config  # noqa: E402

FPS = 60.0
START = np.array([0.3, -1.2, 1.4, -1.0, -1.2, 0.2])
HOME = np.array([0, -0.8, 0, -2.4, 0, 1.6, 0.8])


def leader_qpos(tick):
    """A smooth motion of a Panda from its pose at home [rad]."""
    return HOME + 0.1 * np.sin(tick / FPS * np.arange(1, 8))


@TeleoperatorConfig.register_subclass("simulated_leader")
@dataclasses.dataclass(kw_only=True)
class SimulatedLeaderConfig(TeleoperatorConfig):
    """Options of a leader that moves by itself."""


class SimulatedLeader(Teleoperator):
    config_class, name = SimulatedLeaderConfig, "simulated_leader"
    action_features = dict.fromkeys([f"joint{i}.pos" for i in range(1, 8)] + [plugin.GRIPPER], float)
    feedback_features: dict[str, type] = {}
    is_connected = False
    is_calibrated = True

    def __init__(self, config):
        super().__init__(config)
        self._tick = 0

    def connect(self, calibrate=True):
        self.is_connected = True

    def calibrate(self):
        return None

    def configure(self):
        return None

    def get_action(self):
        self._tick += 1
        values = np.degrees(leader_qpos(self._tick - 1))
        return {f"joint{i}.pos": float(x) for i, x in enumerate(values, start=1)} | {plugin.GRIPPER: 25.0}

    def send_feedback(self, feedback):
        return None

    def disconnect(self):
        self.is_connected = False


@pytest.fixture
def options(tmp_path):
    file = original_model.ur_file(tmp_path)
    return {"leader_model": "panda", "follower_model": str(file), "fps": FPS, "velocity": 3.0, "gripper": [0.0, 0.08]}


def test_the_teleoperator_repeats_the_motion_of_the_leader_s_hand(options, tmp_path, monkeypatch):
    """From the follower's start pose, and within its velocity limits; LeRobot itself makes the device."""
    leader = SimulatedLeaderConfig(calibration_dir=tmp_path)
    start = np.degrees(START).tolist()
    config = plugin.MimicTeleoperatorConfig(leader=leader, start=start, calibration_dir=tmp_path, **options)
    assert config.type == "mimic"
    monkeypatch.setattr(plugin, "make_teleoperator_from_config", SimulatedLeader)  # it finds devices in packages alone
    device = make_teleoperator_from_config(config)
    device.connect()
    actions = [device.get_action() for _ in range(120)]
    device.disconnect()
    assert set(actions[0]) == set(device.action_features) and not device.is_connected
    follower = mimic.build_arm(mimic.ArmConfig(model=options["follower_model"]), "hardware").embodiment
    qpos = np.radians([[action[f"{name}.pos"] for name in follower.joint_names] for action in actions])
    assert np.abs(np.diff(qpos, axis=0)).max() <= 3.0 / FPS + 1e-9
    panda = mimic.build_arm(mimic.ArmConfig(), "hardware").embodiment
    moved = hand_poses(follower, qpos[-1])[0, :3, 3] - hand_poses(follower, START)[0, :3, 3]
    led = hand_poses(panda, leader_qpos(119))[0, :3, 3] - hand_poses(panda, HOME)[0, :3, 3]
    assert np.linalg.norm(led) > 0.03
    np.testing.assert_allclose(moved, led, atol=5e-3)  # m: the command is a few ticks behind
    assert actions[-1][plugin.GRIPPER] == pytest.approx(0.02)  # a quarter open


def test_the_step_starts_where_the_robot_is(options):
    step = plugin.MimicFollowerStep(**options)
    pipeline = RobotProcessorPipeline(
        steps=[step], to_transition=robot_action_observation_to_transition, to_output=transition_to_robot_action
    )
    follower = mimic.build_arm(mimic.ArmConfig(model=options["follower_model"]), "hardware").embodiment
    observation = {f"{name}.pos": float(x) for name, x in zip(follower.joint_names, np.degrees(START), strict=True)}
    leader = {f"joint{i}.pos": float(x) for i, x in enumerate(np.degrees(HOME), start=1)}
    action = pipeline((leader, observation))
    assert set(action) == set(observation)
    assert [action[name] for name in observation] == pytest.approx(list(observation.values()), abs=0.5)
    lost = pipeline(({}, observation))  # a sample without the leader's joints: the follower holds
    assert np.isfinite(list(lost.values())).all()
    assert plugin.MimicFollowerStep(**step.get_config()).get_config() == step.get_config()


@real_data.needs(real_data.DATA / "arms/so101/so101_new_calib.urdf")
def test_an_so101_drives_a_piper():
    """The hand of the six joints goes as far as that of the five, and a gripper goes with it."""
    models = [str(real_data.DATA / "arms" / file) for file in ("so101/so101_new_calib.urdf", "piper.urdf")]
    arms = [mimic.build_arm(mimic.ArmConfig(model=model), "hardware").embodiment for model in models]
    start = np.array([0.0, 1.2, -1.2, 0.0, 0.5, 0.0])
    step = plugin.MimicFollowerStep(
        leader_model=models[0], follower_model=models[1], fps=FPS, velocity=3.0, start=np.degrees(start).tolist()
    )
    pipeline = RobotProcessorPipeline(
        steps=[step], to_transition=robot_action_observation_to_transition, to_output=transition_to_robot_action
    )
    led, actions = 0.2 * np.sin(np.minimum(np.arange(150), 120)[:, None] / FPS * np.arange(1, 6)), []
    for qpos in led:
        names = (f"{name}.pos" for name in arms[0].joint_names)
        actions.append(pipeline((dict(zip(names, np.degrees(qpos), strict=True)) | {plugin.GRIPPER: 25.0}, {})))
    moved = np.radians([[action[f"{name}.pos"] for name in arms[1].joint_names] for action in actions])
    of_leader, of_follower = (
        hand_poses(arm, path[-1])[0, :3, 3] - hand_poses(arm, path[0])[0, :3, 3]
        for arm, path in zip(arms, (led, moved), strict=True)
    )
    assert np.linalg.norm(of_leader) > 0.02
    np.testing.assert_allclose(of_follower, of_leader, atol=1e-3)  # m, as `REACHED`
    assert actions[-1][plugin.GRIPPER] == pytest.approx(25.0)


@pytest.mark.parametrize(("values", "message"), [
    ({"units": "turns"}, "units: expected degrees or radians, got 'turns'"),
    ({"start": [1.0]}, "start: expected the follower's pose, pan.pos, lift.pos"),
    ({"start": [0, 0, 0, 0, 0, 5000.0]}, "qpos: expected 6 angles within the follower's limits"),
])  # fmt: skip
def test_bad_options(options, values, message):
    with pytest.raises(ValueError, match=message):
        plugin.MimicFollowerStep(**options, **values).follow({}, {})
