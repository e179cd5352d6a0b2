"""The live view with a mapper to any arm: time of a frame after a change of the learner, and the mapper's quality.

    python -m benchmarks.view_any_arm [--frames 900] [--poses 300] [--learners [panda,panda4dof,ur5e.xml]] [--out FILE]

A frame is the whole work of the server, from the poses to the messages; the expert moves in each of them. Every tenth
frame comes after a lock of a random joint, or its end, every fiftieth after a change of the arm. The quality is
measured with joints of the Panda locked at home, as in training, and anywhere: 0 is the kinematic bound, 1 a random
pose.
"""

import argparse
import dataclasses
import socket
import time
from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

import numpy as np

from benchmarks.common.parser import make_parser
from benchmarks.common.record import Row, print_table, write_results

if TYPE_CHECKING:
    from mimic.viewer.page import Page

_STEP = 0.03  # rad, of each joint of the expert between frames
_PAUSE = 0.005  # s, in which the server's thread sends
_COMPILE = "/jax/core/compile"


def prepare(learners: str) -> tuple[Any, Any, Any, Any]:
    """The environment, the learners, their presets and their compiled functions."""
    import mimic
    from mimic.commands.config import ViewConfig
    from mimic.commands.view_any_arm import AnyLearnerFunctions, read_learners
    from mimic.envs.config import ArmsConfig

    mapper = mimic.load("any_arm", "pose_mapper")
    config = ViewConfig(mapper="any_arm", learners=learners.strip("[]").split(","))
    named = config.resolve_learners(mapper.env.learner)
    arms, presets = read_learners(named, mapper.env.limits, mapper.env.metric.links)
    env = dataclasses.replace(mapper.env, arms=ArmsConfig(), learner=next(iter(named.values())))
    functions = AnyLearnerFunctions(mapper, arms)
    functions.finish()
    return env, arms, presets, functions


def frame_times(env: Any, arms: Any, presets: Any, functions: Any, count: int) -> list[Row]:
    """Time of a frame [ms], and compilations, by what has changed before it."""
    import jax

    from mimic.commands import view_server
    from mimic.commands.config import ViewConfig
    from mimic.viewer.controls import LiveControls
    from mimic.viewer.history import History
    from mimic.viewer.learner_controls import LearnerControls
    from mimic.viewer.live_session import LiveSession
    from mimic.viewer.manual_controls import ManualControls

    times: dict[str, list[float]] = {"nothing": [], "lock": [], "arm": []}
    compilations: list[str] = []

    def show(page: "Page", _: Iterator[float]) -> None:
        session = LiveSession(env, any_arm=functions)
        learner = LearnerControls(session, page.starts, presets)
        LiveControls(page.server, session, env, ManualControls(session, env, page.expert), learner)
        history, random = History(), np.random.default_rng(0)
        jax.monitoring.register_event_duration_secs_listener(lambda event, *_, **__: compilations.append(event))
        for number in range(count):
            session.show_pose(np.clip(session.pose + _STEP * random.standard_normal(7), -2, 2))
            changed = "arm" if number % 50 == 45 else "lock" if number % 10 == 5 else "nothing"
            began = time.perf_counter()
            if changed == "arm":
                preset = presets[number // 50 % len(presets)]
                session.choose(preset.arm, preset.locked, page.starts[preset.arm])
            elif changed == "lock":
                joint = str(random.choice(arms[session.settings.arm].arm.embodiment.joint_names))
                session.lock(joint, joint not in session.settings.locked)
            learner.update()
            frame = session.advance(1 / 30)
            assert frame is not None
            history.add(frame)
            page.show(frame, history.chart(), "")
            times[changed].append(1e3 * (time.perf_counter() - began))
            time.sleep(_PAUSE)

    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        config = ViewConfig(mapper="any_arm", port=probe.getsockname()[1])
    drawn = {f"{index}": arm.config for index, arm in enumerate(arms)}
    view_server.serve(config, env, "any_arm", show, learners=drawn)
    compiled = sum(event.startswith(_COMPILE) for event in compilations)
    return [
        {"changed": name, "frames": len(values), "compilations": compiled, **_quantiles(values)}
        for name, values in times.items()
    ]


def _quantiles(values: list[float]) -> Row:
    return {f"{name}_ms": round(float(np.percentile(values, q)), 2) for name, q in (("p50", 50), ("p90", 90))} | {
        "max_ms": round(max(values), 2)
    }


def quality(env: Any, functions: Any, poses: int) -> Iterator[Row]:
    """(distance - bound) / (random - bound) of the mapper on the first arm with locked joints, means over poses."""
    from mimic.viewer.follower import initial_settings

    settings = dataclasses.replace(initial_settings(env), locked={})
    arm = functions.wait(settings).learner.embodiment
    lower, upper = np.asarray(arm.joint_range).T
    for count in (1, 2):
        for place in ("home", "anywhere"):
            random, distances = np.random.default_rng(count), []
            for _ in range(poses):
                at = arm.home if place == "home" else random.uniform(lower, upper)
                chosen = random.choice(arm.num_joints, count, replace=False)
                locked = {arm.joint_names[joint]: float(at[joint]) for joint in chosen}
                of_arm = functions.wait(dataclasses.replace(settings, locked=locked))
                expert = random.uniform(lower, upper).astype(np.float32)
                other = random.uniform(lower, upper).astype(np.float32)
                other[chosen] = [locked[arm.joint_names[joint]] for joint in chosen]
                pose = of_arm.follow(expert, other, settings.weights)
                compared = [of_arm.compare(expert, q, settings.weights).distance for q in (pose, other)]
                distances.append(
                    [float(compared[0]), float(of_arm.best(expert, settings.weights)[1]), float(compared[1])]
                )
            mapped, bound, at_random = np.mean(distances, axis=0)
            fraction = (mapped - bound) / (at_random - bound)
            yield {"locked": count, "at": place, "distance": mapped, "bound": bound, "quality": fraction}


def measure(options: argparse.Namespace) -> tuple[list[Row], list[Row]]:
    import jax

    jax.config.update("jax_cpu_enable_async_dispatch", False)  # as the view does
    env, arms, presets, functions = prepare(options.learners)
    return frame_times(env, arms, presets, functions, options.frames), list(quality(env, functions, options.poses))


def main() -> None:
    options = make_parser(
        "view_any_arm", __doc__, frames=900, poses=300, learners="[panda,panda4dof,panda3dof]"
    ).parse_args()
    frames, locks = measure(options)
    write_results(options, learners=options.learners, frames=frames, quality=locks)
    print_table(frames, "changed frames compilations p50_ms:.1f p90_ms:.1f max_ms:.1f")
    print_table(locks, "locked at distance:.3f bound:.3f quality:.2%")


if __name__ == "__main__":
    main()
