"""Virtual robots in lockstep: each period they take torques, check them as a real robot does, and simulate 1 ms.

Arrays are [robots, joints]. This module needs MuJoCo and NumPy alone.
"""

import copy

import mujoco
import numpy as np

from mimic.control.joint_control import PERIOD, friction_torque
from mimic.evaluation.virtual_robot.arm_model import RobotModel
from mimic.evaluation.virtual_robot.draws import World
from mimic.physics.mujoco_world import FLOOR, disabled, loaded_fields

START_POSE, POSITION, VELOCITY = "start pose invalid", "joint position limit", "joint velocity limit"
TORQUE, TORQUE_RATE, SELF_CONTACT, FLOOR_CONTACT = "torque limit", "torque rate", "self-contact", "floor contact"
LIMIT_CAUSES = (POSITION, VELOCITY, TORQUE, TORQUE_RATE)
_ROUNDING = 1e-6  # relative, of a torque at its limit


class VirtualRobots:
    """Some robots of one model, each with its own load, friction and sensors.

    Args:
      robot: the model.
      world: of each robot.
      start_poses: [robots, joints] [rad]; the world's start offset is added.
      seed: of the sensors' noise.

    Attributes:
      qpos, qvel: true angles [rad] and velocities [rad/s], [robots, joints].
      torque: last commanded torques [N m].
      cause: [robots] why a robot aborted; empty where it did not.
      periods: since the start.
    """

    def __init__(self, robot: RobotModel, world: World, start_poses: np.ndarray, seed: int = 0):
        count = len(start_poses)
        self._robot, self._world = robot, world
        self._models = [_loaded_model(robot, world, i) for i in range(count)]
        self._data = [mujoco.MjData(model) for model in self._models]
        self._applied = [data.qfrc_applied for data in self._data]
        self._states = [(data.qpos, data.qvel) for data in self._data]
        self._floor = robot.simulated.model.geom(FLOOR).id
        self._level = world.friction * robot.friction.level
        self._rng = np.random.default_rng(seed)
        self.qpos = np.asarray(start_poses, float) + world.start_offset
        self.qvel: np.ndarray = np.zeros(self.qpos.shape)
        self.torque: np.ndarray = np.zeros(self.qpos.shape)
        self.cause = np.full(count, "", object)
        self.periods = 0
        for data, qpos in zip(self._data, self.qpos, strict=True):
            data.qpos[:] = qpos
        lower, upper = robot.limits.position.T
        self._abort(np.any((self.qpos < lower) | (self.qpos > upper), axis=1), START_POSE)

    @property
    def is_active(self) -> np.ndarray:
        """[robots] whether a robot has not aborted."""
        return self.cause == ""

    def measure(self) -> tuple[np.ndarray, np.ndarray]:
        """Measured angles and velocities."""
        qpos, qvel = self.qpos + self._world.position_bias, self.qvel
        if self._world.position_noise:
            qpos = qpos + self._world.position_noise * self._rng.standard_normal(qpos.shape)
        if self._world.velocity_noise:
            qvel = qvel + self._world.velocity_noise * self._rng.standard_normal(qvel.shape)
        return qpos, np.array(qvel)

    def step(self, torque: np.ndarray) -> None:
        """One period with torques in addition to gravity compensation."""
        self._check_command(torque)
        self.torque = torque
        friction = friction_torque(self.qvel, self._level, self._robot.friction.rate, np)
        applied = self._world.motor_gain * torque - friction
        for i in np.flatnonzero(self.cause == "").tolist():
            self._applied[i][:] = applied[i]
            mujoco.mj_step(self._models[i], self._data[i])
            self.qpos[i], self.qvel[i] = self._states[i]
            if self._data[i].ncon:
                self._check_contacts(i)
        self.periods += 1
        self._check_state()

    def _check_command(self, torque: np.ndarray) -> None:
        limits = self._robot.limits
        change = np.abs(torque - self.torque)
        is_abrupt = ~np.all(change <= limits.torque_rate * PERIOD * (1 + _ROUNDING), axis=1)  # True for NaN
        self._abort(is_abrupt, TORQUE_RATE)
        self._abort(np.any(np.abs(torque) > limits.torque * (1 + _ROUNDING), axis=1), TORQUE)

    def _check_contacts(self, robot: int) -> None:
        data = self._data[robot]
        is_touching = [contact.geom for contact in data.contact if contact.dist < 0]
        if not is_touching:
            return
        is_floor = all(self._floor in geoms for geoms in is_touching)
        if self.cause[robot] == "":
            self.cause[robot] = FLOOR_CONTACT if is_floor else SELF_CONTACT

    def _check_state(self) -> None:
        limits = self._robot.limits
        lower, upper = limits.position.T
        self._abort(~np.all((self.qpos >= lower) & (self.qpos <= upper), axis=1), POSITION)
        self._abort(~np.all(np.abs(self.qvel) <= limits.velocity, axis=1), VELOCITY)

    def _abort(self, is_aborted: np.ndarray, cause: str) -> None:
        self.cause[is_aborted & (self.cause == "")] = cause


def _loaded_model(robot: RobotModel, world: World, index: int) -> mujoco.MjModel:
    """The model of a robot in its world."""
    simulated = robot.simulated
    gravity_error, link_mass, payload, lever = (
        x[index] for x in (world.gravity_error, world.link_mass, world.payload, world.payload_lever)
    )
    fields = loaded_fields(simulated, gravity_error, link_mass, payload, lever, np)
    model = copy.copy(simulated.model)
    model.opt.disableflags = disabled(gravity=world.gravity, stops=world.stops, contacts=world.contacts)
    model.opt.gravity[:] = fields.gravity
    model.body_mass[:], model.body_inertia[:], model.body_ipos[:] = fields[1:]
    mujoco.mj_setConst(model, mujoco.MjData(model))
    return model
