"""A leader arm of LeRobot drives a follower of another embodiment: a teleoperator, and the processor step in it.

    pip install ./examples/lerobot_teleoperator_mimic
    lerobot-teleoperate --robot.type=FOLLOWER --teleop.type=mimic \
        --teleop.leader.type=so101_leader --teleop.leader.port=/dev/ttyACM0 \
        --teleop.leader_model=so101.urdf --teleop.follower_model=piper.urdf --teleop.start='[0,60,-60,0,30,0]'

A joint's value is the one of the feature NAME.pos, with the joint's name in the model, and its zero is the model's.
"""

# pyright: reportMissingImports=false

import logging
from dataclasses import dataclass, field, fields
from typing import Any

import numpy as np
from lerobot.configs.types import FeatureType, PipelineFeatureType, PolicyFeature
from lerobot.processor import ProcessorStepRegistry, RobotActionProcessorStep, TransitionKey
from lerobot.teleoperators import make_teleoperator_from_config
from lerobot.teleoperators.config import TeleoperatorConfig
from lerobot.teleoperators.teleoperator import Teleoperator

import mimic

GRIPPER = "gripper.pos"
_UNITS = {"degrees": np.pi / 180, "radians": 1.0}
_BEYOND = 0.05  # rad; a robot that stands beyond its limits by no more starts at them
_log = logging.getLogger(__name__)


@dataclass(kw_only=True)
class Options:
    """What drives a follower.

    Attributes:
      leader_model, follower_model: MJCF or URDF files, or names of arms that mimic knows.
      start: the follower's pose at the start, in its units. The step takes it from the observation, if there is one.
      hand, base, scale, mirror, velocity: see `mimic.Teleoperator`.
      fps: rate of the loop, as LeRobot's --fps.
      leader_units, units: of the leader's and the follower's joints: degrees or radians.
      leader_gripper, gripper: values of the gripper, closed and open.
    """

    leader_model: str
    follower_model: str
    start: list[float] | None = None
    hand: str = "relative"
    base: list[float] = field(default_factory=lambda: [0.0, 0.0, 0.0, 0.0])
    scale: float = 1.0
    mirror: bool = False
    velocity: float | None = None
    fps: float = 60.0
    leader_units: str = "degrees"
    units: str = "degrees"
    leader_gripper: list[float] = field(default_factory=lambda: [0.0, 100.0])
    gripper: list[float] = field(default_factory=lambda: [0.0, 100.0])

    def __post_init__(self) -> None:
        for name in ("leader_units", "units"):
            if getattr(self, name) not in _UNITS:
                raise ValueError(f"{name}: expected degrees or radians, got {getattr(self, name)!r}")


@ProcessorStepRegistry.register("mimic_follower")
@dataclass(kw_only=True)
class MimicFollowerStep(RobotActionProcessorStep, Options):
    """Replaces the leader's joints in an action by the follower's, of which it has the name and the units."""

    def __post_init__(self) -> None:
        super().__post_init__()
        self._leader, follower = (
            mimic.build_arm(mimic.ArmConfig(model=model), "hardware").embodiment
            for model in (self.leader_model, self.follower_model)
        )
        hand: Any = self.hand
        self._operator = mimic.Teleoperator(
            self._leader, follower, hand=hand, base=self.base, scale=self.scale, mirror=self.mirror, rate=self.fps,
            velocity=self.velocity, grippers=(tuple(self.leader_gripper), tuple(self.gripper)),
        )  # fmt: skip
        self._names = [f"{name}.pos" for name in follower.joint_names]
        self._leader_names = [f"{name}.pos" for name in self._leader.joint_names]
        self._has_begun, self._state = False, ""

    def action(self, action: dict[str, Any]) -> dict[str, Any]:
        """The follower's action for one of the leader."""
        return self.follow(action, self.transition.get(TransitionKey.OBSERVATION) or {})

    def follow(self, action: dict[str, Any], observation: dict[str, Any]) -> dict[str, Any]:
        """The follower's action for one of the leader, and an observation of the follower, which may be empty."""
        if not self._has_begun:
            self._begin(observation)
        qpos = [action.pop(name, np.nan) for name in self._leader_names]  # of a lost joint the sample is ignored
        command = self._operator.step(_UNITS[self.leader_units] * np.array(qpos), action.pop(GRIPPER, None))
        if command.status.state != self._state:
            self._state = command.status.state
            _log.info("follower: %s %s", self._state, command.status.reason)
        values = dict(zip(self._names, (command.qpos / _UNITS[self.units]).tolist(), strict=True))
        return action | values | ({} if command.gripper is None else {GRIPPER: command.gripper})

    def reset(self) -> None:
        """Lets the next action begin where the follower is then."""
        self._operator.disengage()
        self._has_begun = False

    def _begin(self, observation: dict[str, Any]) -> None:
        pose = [observation[name] for name in self._names if name in observation]
        pose = pose if len(pose) == len(self._names) else self.start
        if pose is None or len(pose) != len(self._names):
            raise ValueError(
                f"start: expected the follower's pose, {', '.join(self._names)} in {self.units}, got {pose}"
            )
        qpos = _UNITS[self.units] * np.array(pose, float)
        inside = np.clip(qpos, *self._operator.limits.position.T)
        self._operator.reset(np.where(np.abs(qpos - inside) < _BEYOND, inside, qpos))
        self._operator.engage()
        self._has_begun = True

    def get_config(self) -> dict[str, Any]:
        """The options, which LeRobot saves with a pipeline."""
        return {entry.name: getattr(self, entry.name) for entry in fields(Options)}

    def transform_features(
        self, features: dict[PipelineFeatureType, dict[str, PolicyFeature]]
    ) -> dict[PipelineFeatureType, dict[str, PolicyFeature]]:
        """The features with the follower's joints in place of the leader's."""
        actions = features[PipelineFeatureType.ACTION]
        kept = {name: feature for name, feature in actions.items() if name not in self._leader_names}
        added = {name: PolicyFeature(type=FeatureType.ACTION, shape=(1,)) for name in self._names}
        return features | {PipelineFeatureType.ACTION: kept | added}


@TeleoperatorConfig.register_subclass("mimic")
@dataclass(kw_only=True)
class MimicTeleoperatorConfig(TeleoperatorConfig, Options):
    """Options of the teleoperator."""

    leader: TeleoperatorConfig
    """LeRobot's device of the leader."""  # draccus 0.10 shows this line, and fails without one


class MimicTeleoperator(Teleoperator):
    """A leader device of LeRobot, whose actions are those of the follower."""

    config_class = MimicTeleoperatorConfig
    name = "mimic"

    def __init__(self, config: MimicTeleoperatorConfig):
        super().__init__(config)
        self._step = MimicFollowerStep(**{entry.name: getattr(config, entry.name) for entry in fields(Options)})
        self._leader = make_teleoperator_from_config(config.leader)

    @property
    def action_features(self) -> dict[str, type]:
        names = [*self._step._names, *({GRIPPER} & set(self._leader.action_features))]
        return dict.fromkeys(names, float)

    @property
    def feedback_features(self) -> dict[str, type]:
        return {}

    @property
    def is_connected(self) -> bool:
        return self._leader.is_connected

    @property
    def is_calibrated(self) -> bool:
        return self._leader.is_calibrated

    def connect(self, calibrate: bool = True) -> None:
        self._leader.connect(calibrate)
        self._step.reset()

    def calibrate(self) -> None:
        self._leader.calibrate()

    def configure(self) -> None:
        self._leader.configure()

    def get_action(self) -> dict[str, Any]:
        return self._step.follow(dict(self._leader.get_action()), {})

    def send_feedback(self, feedback: dict[str, Any]) -> None:
        del feedback

    def disconnect(self) -> None:
        self._leader.disconnect()
