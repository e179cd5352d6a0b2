"""A ROS 2 node: a leader arm drives a follower of another embodiment, from one topic of JointState messages to another.

    python ros_teleoperation.py panda follower.urdf 100     # leader, follower, ticks per second

The follower must stand at its measured pose on /follower/joint_states when it starts. The leader's joints arrive on
/leader/joint_states, in any order and with further joints; commands leave on /follower/joint_command.
"""

import sys
from typing import Any

import numpy as np

import mimic


class JointStateFollower:
    """Turns joint states of a leader into commands of a follower.

    Args:
      leader, follower: model files or names of arms.
      rate: ticks per second.
      options: of `mimic.Teleoperator`.
    """

    def __init__(self, leader: str, follower: str, rate: float, **options: Any):
        arms = [mimic.build_arm(mimic.ArmConfig(model=model), "hardware").embodiment for model in (leader, follower)]
        self._leader, self._follower = (arm.joint_names for arm in arms)
        self._operator = mimic.Teleoperator(arms[0], arms[1], rate=rate, **options)
        self._sample, self._has_begun = None, False

    def measured(self, message: Any) -> None:
        """Takes the follower's measured pose, from which it starts."""
        qpos = _angles(message, self._follower)
        if not self._has_begun and qpos is not None:
            self._operator.reset(np.clip(qpos, *self._operator.limits.position.T))
            self._operator.engage()
            self._has_begun = True

    def lead(self, message: Any) -> None:
        """Takes a sample of the leader; one without all of its joints is ignored."""
        qpos = _angles(message, self._leader)
        if qpos is not None:
            self._sample = qpos, message.header.stamp.sec + 1e-9 * message.header.stamp.nanosec

    def tick(self) -> tuple[list[str], np.ndarray] | None:
        """Names and angles [rad] of the next command; None before the follower's pose is known."""
        if not self._has_begun:
            return None
        (qpos, time), self._sample = self._sample or (None, None), None
        return list(self._follower), self._operator.step(qpos, time=time).qpos


def _angles(message: Any, names: tuple[str, ...]) -> np.ndarray | None:
    angles = dict(zip(message.name, message.position, strict=False))
    return np.array([angles[name] for name in names]) if all(name in angles for name in names) else None


def main() -> None:
    """Runs the node."""
    import rclpy  # pyright: ignore[reportMissingImports]
    from sensor_msgs.msg import JointState  # pyright: ignore[reportMissingImports]

    leader, follower, rate = sys.argv[1], sys.argv[2], float(sys.argv[3])
    arm = JointStateFollower(leader, follower, rate, hand="relative")
    rclpy.init()
    node = rclpy.create_node("mimic_teleoperation")
    node.create_subscription(JointState, "/leader/joint_states", arm.lead, 1)
    node.create_subscription(JointState, "/follower/joint_states", arm.measured, 1)
    commands = node.create_publisher(JointState, "/follower/joint_command", 1)

    def publish() -> None:
        command = arm.tick()
        if command is not None:
            message = JointState(name=command[0], position=command[1].tolist())
            message.header.stamp = node.get_clock().now().to_msg()
            commands.publish(message)

    node.create_timer(1 / rate, publish)
    rclpy.spin(node)


if __name__ == "__main__":
    main()
