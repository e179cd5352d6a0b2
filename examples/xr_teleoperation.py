"""The pose of a person's hand, as a headset gives it, drives an arm.

    python examples/xr_teleoperation.py panda --port 9000 --record driven

Poses arrive at a socket of this machine, a line of JSON each. WebXR and OpenXR give them as they are, with y up:

    {"time": 0.01, "hand": {"position": [0.1, 1.2, -0.3], "wxyz": [1, 0, 0, 0]}, "gripper": 0.5, "frame": "xr"}

The gripper is 0 where the fingers are closed and 1 where they are open. Without "frame" the axes are x forward, y left
and z up. A gap of more than half a second opens the clutch: the hand may then be anywhere.
"""

import argparse
import contextlib
import time
from collections.abc import Callable

import numpy as np

import mimic
from mimic.motions.mocap.point_socket import PointListener

GAP = 0.5  # s


def drive(
    listener: PointListener, operator: mimic.TeleoperationRecorder, send: Callable[[mimic.FollowerCommand], None]
) -> None:
    """Sends a command of the newest pose; one call a tick."""
    sample, arm = listener.take(), operator.operator
    hand = None if sample is None else sample.hand
    if listener.silence > GAP and arm.is_engaged:
        arm.disengage()
    elif hand is not None and not arm.is_engaged:
        arm.engage()
    pose, gripper = (None, None) if hand is None else hand
    send(operator.step(pose, gripper, None if sample is None else sample.time))


def follow_hand(arm: str, rate: float, velocity: float | None) -> mimic.TeleoperationRecorder:
    """What a hand drives; its links are kept apart where its model has shapes."""
    config, capsules = mimic.ArmConfig(model=arm), None
    follower = mimic.build_arm(config, "hardware").embodiment
    try:
        capsules = mimic.fit_capsules(config, "hardware")
    except ValueError as error:
        print(f"links are not kept apart: {error}", flush=True)
    operator = mimic.Teleoperator(
        None, follower, hand="relative", rate=rate, velocity=velocity, capsules=capsules
    )  # fmt: skip
    return mimic.TeleoperationRecorder(operator)


def main() -> None:
    """Drives until Ctrl-C."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("arm", help="MJCF or URDF file, or the name of an arm")
    parser.add_argument("--port", type=int, default=9000)
    parser.add_argument("--rate", type=float, default=100.0, help="ticks per second")
    parser.add_argument("--velocity", type=float, help="maximum speed of the joints [rad/s], for a model without")
    parser.add_argument("--record", help="new folder for a LeRobot data set of what was driven")
    options = parser.parse_args()

    try:
        recorder, state = follow_hand(options.arm, options.rate, options.velocity), ""
    except ValueError as error:
        raise SystemExit(f"error: {error}") from None

    def send(command: mimic.FollowerCommand) -> None:
        """The place of the robot's driver; here it prints what changes."""
        nonlocal state
        if command.status.state != state:
            state = command.status.state
            print(f"{state} {command.status.reason}", np.round(command.qpos, 2), command.gripper, flush=True)

    with contextlib.closing(PointListener("localhost", options.port)) as listener:
        print(f"poses of a hand at tcp://localhost:{listener.port}   (Ctrl-C ends it)", flush=True)
        with contextlib.suppress(KeyboardInterrupt):
            start, ticks = time.perf_counter(), 0
            while True:
                drive(listener, recorder, send)
                ticks += 1
                time.sleep(max(0.0, start + ticks / options.rate - time.perf_counter()))
    if options.record:
        recorder.write(options.record)


if __name__ == "__main__":
    main()
