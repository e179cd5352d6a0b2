"""Bags of ROS 2 with given motions, as recorders write them."""

from typing import Any

import numpy as np

SECOND = 10**9  # ns
TYPE = "sensor_msgs/msg/JointState"


def write_bags(folder, episodes) -> None:
    """Writes a bag for each episode, with the states of both arms and what was commanded of them."""
    from rosbags.rosbag2 import Writer
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS2_HUMBLE)
    types: Any = store.types
    header, time = types["std_msgs/msg/Header"], types["builtin_interfaces/msg/Time"]
    for episode, steps in enumerate(episodes.steps):
        with Writer(folder / f"episode_{episode:06d}", version=8) as writer:
            for name, arm in {"expert": episodes.expert, "learner": episodes.robot}.items():
                states, commands = (
                    writer.add_connection(f"/{name}/joint_{kind}", TYPE, typestore=store)
                    for kind in ("states", "commands")
                )
                for sample in range(steps + 1):
                    stamp = SECOND + round(sample * episodes.dt * SECOND)
                    head, none = header(time(stamp // SECOND, stamp % SECOND), ""), np.zeros(0)
                    names, qpos, qvel = list(arm.joint_names), arm.qpos[episode, sample], arm.qvel[episode, sample]
                    state = types[TYPE](head, names, qpos, qvel, none)
                    writer.write(states, stamp, store.serialize_cdr(state, TYPE))
                    if sample < steps:
                        command = types[TYPE](head, names, none, none, arm.command[episode, sample])
                        writer.write(commands, stamp, store.serialize_cdr(command, TYPE))
