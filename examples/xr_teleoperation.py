"""The pose of a person's hand, as a headset gives it, drives an arm.

    python examples/xr_teleoperation.py panda --port 9000 --record driven

Poses arrive at a socket of this machine, a line of JSON each. WebXR and OpenXR give them as they are, with y up:

    {"time": 0.01, "hand": {"position": [0.1, 1.2, -0.3], "wxyz": [1, 0, 0, 0]}, "gripper": 0.5, "frame": "xr"}

The gripper is 0 where the fingers are closed and 1 where they are open. Without "frame" the axes are x forward, y left
and z up. A gap of more than half a second, or a jump, opens the clutch: the hand may then be anywhere.
"""

import argparse
import contextlib
import time
from collections.abc import Callable

import numpy as np

import mimic
from mimic.base.config import new_path
from mimic.base.distribution import import_extra
from mimic.motions.formats.episodes import EXTRA
from mimic.motions.mocap.point_socket import PointListener

GAP = 0.5  # s


def drive(
    listener: PointListener,
    operator: mimic.Teleoperator,
    send: Callable[[mimic.FollowerCommand], None],
    recorder: mimic.TeleoperationRecorder | None = None,
) -> None:
    """Sends a command of the newest pose, and keeps it in a recorder; one call a tick."""
    sample = listener.take()
    hand = None if sample is None else sample.hand
    if listener.silence > GAP and operator.is_engaged:
        operator.disengage()
    elif hand is not None and not operator.is_engaged:
        operator.engage()
    pose, gripper = (None, None) if hand is None else hand
    command = (recorder or operator).step(pose, gripper, None if sample is None else sample.time)
    if operator.is_engaged and "jumped" in command.status.reason:
        operator.disengage()  # as the headset's space was recentred: the next pose leads from where it is
    send(command)


def follow_hand(arm: str, rate: float, velocity: float | None) -> mimic.Teleoperator:
    """What a hand drives; its links are kept apart where its model has shapes."""
    config, capsules = mimic.ArmConfig(model=arm), None
    follower = mimic.build_arm(config, "hardware").embodiment
    try:
        capsules = mimic.fit_capsules(config, "hardware")
    except ValueError as error:
        print(f"links are not kept apart: {error}", flush=True)
    return mimic.Teleoperator(None, follower, hand="relative", rate=rate, velocity=velocity, capsules=capsules)


def main() -> None:
    """Drives until Ctrl-C."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("arm", help="MJCF or URDF file, or the name of an arm")
    parser.add_argument("--port", type=int, default=9000)
    parser.add_argument("--rate", type=float, default=100.0, help="ticks per second")
    parser.add_argument("--velocity", type=float, help="maximum speed of the joints [rad/s], for a model without")
    parser.add_argument("--record", help="new folder for a LeRobot data set of what was driven")
    options = parser.parse_args()

    recorder, state = None, ""
    try:
        if options.record:
            new_path("record", options.record)
            import_extra("pyarrow", EXTRA, "record")
        operator = follow_hand(options.arm, options.rate, options.velocity)
        if options.record:
            recorder = mimic.TeleoperationRecorder(operator)
        listener = PointListener("localhost", options.port)
    except ValueError as error:
        raise SystemExit(f"error: {error}") from None

    def send(command: mimic.FollowerCommand) -> None:
        """The place of the robot's driver; here it prints what changes."""
        nonlocal state
        if command.status.state != state:
            state = command.status.state
            print(f"{state} {command.status.reason}", np.round(command.qpos, 2), command.gripper, flush=True)

    print(f"poses of a hand at tcp://localhost:{listener.port}   (Ctrl-C ends it)", flush=True)
    try:
        with contextlib.closing(listener), contextlib.suppress(KeyboardInterrupt):
            due = time.perf_counter()
            while True:
                drive(listener, operator, send, recorder)
                due = max(due + 1 / options.rate, time.perf_counter())  # ticks that are late are not caught up
                time.sleep(max(0.0, due - time.perf_counter()))
    finally:
        if recorder is not None and recorder.episodes:
            recorder.write(options.record)


if __name__ == "__main__":
    main()
