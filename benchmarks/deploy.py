"""Times of `mimic.deploy`: `python -m benchmarks.deploy [--out FILE] [--bundle FOLDER] [--motions N]`.

A period of the inner loop lasts 1 ms. It is timed from a state to its torque, with the checks of the measurement, which
is what a robot waits for; and to the end of its computation, with a part of the check of a target. The policy is timed
in its own process, at the rate at which the inner loop asks it: its evaluation, and from sending an observation to the
answer, where it also waits for the core. Together are the time to the torque at a tick and the evaluation of its
observation. The policy shares the core of the inner loop; with `--policy-core N` it has core N for itself and keeps it
busy.
Wall times include what other processes on the core cost; CPU times, which the file has, do not.
The last row is a loop of Python alone, which is as long each time: what its p99.9 is above its p50 is the machine's.

With `--awake` a process of the lowest priority keeps the core of the inner loop from halting between the periods, as
with `cores` of `mimic.deploy.run_controller`. The loop of Python has it too. Here this process times a loop, to tell
when the core has its full speed: a virtual machine may share it with others. `full` is the fraction of the times that
were measured then, `full_p50` to `full_p999` are theirs alone, and the file has the duration of the loop at full speed.
That is the shortest one of the run: where there was no full speed at all, it is longer than in other runs.
"""

import dataclasses
import os
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from benchmarks.common.core_speed import is_full_speed, loop_durations, measured_speed, shortest_loop
from benchmarks.common.parser import make_parser
from benchmarks.common.record import Row, collect
from mimic.deploy.bundle import Bundle, load_bundle
from mimic.deploy.driver import RobotState
from mimic.deploy.fake_robot import FakeRobot
from mimic.deploy.policy_process import PolicyProcess
from mimic.deploy.runner import missed_periods, run_controller

_PERCENTILES, _NAMES = (50, 99, 99.9), ("p50", "p99", "p999")
_COLUMNS = " ".join(
    ["what count", *(f"wall_{name}:.3f" for name in _NAMES), "full:.2f", *(f"full_{name}:.3f" for name in _NAMES)]
    + ["missed"]
)
_LOOP, _LOOPS = 2000, 5000  # additions of a loop, and periods of it


def untrained_bundle(folder: Path) -> Bundle:
    """The controller of an untrained policy for a Panda in the hardware world: it has the size of a trained one."""
    import jax

    import mimic
    from mimic.runs.checkpoints import save_checkpoint
    from mimic.trainers.config import PPOConfig, TrainConfig
    from mimic.trainers.export.export_controller import export_controller
    from mimic.trainers.ppo.ppo import initial_params, make_networks
    from mimic.trainers.ppo.trainer import PPOTrainer
    from mimic.trainers.run_config import save_config
    from mimic.trainers.run_models import save_models

    env = mimic.env_config("panda7dof", world="hardware", demonstrations={"count": 4, "held_out": 1})
    config = TrainConfig(env, PPOConfig(preset="inner_loop"), compilation_cache="").resolve()
    trainer = PPOTrainer(config, None)
    run = folder / "run"
    run.mkdir()
    save_models(run, config.env)
    save_config(run, dataclasses.replace(config, trainer=trainer.settings))
    trainer.save_inputs(run)
    made = trainer.evaluator.env
    networks = make_networks(trainer.settings, made.observation_size, made.action_size)
    save_checkpoint(run, 0, initial_params(networks, made.observation_size, jax.random.PRNGKey(0)))
    export_controller(run, folder / "bundle")
    return load_bundle(folder / "bundle")


class _Robot(FakeRobot):
    """A fake robot in real time that notes when each state is read."""

    def __init__(self, bundle: Bundle):
        super().__init__(bundle.start_pose, bundle.limits, bundle.parameters.inertia, 1.0, is_paced=True)
        self.times: list[float] = []

    def read(self) -> RobotState:
        state = super().read()
        self.times.append(time.perf_counter())
        return state


@dataclasses.dataclass
class _Times:
    """Wall and CPU times [s] of the same events, and durations of a loop on their cores at that time, where known."""

    wall: list[float] = dataclasses.field(default_factory=list)
    cpu: list[float] = dataclasses.field(default_factory=list)
    loops: list[float] = dataclasses.field(default_factory=list)


def _row(what: str, times: _Times, shortest: float = 0.0, **more: int) -> Row:
    """Percentiles; `shortest` is the duration of the loop at full speed [s]."""
    wall = np.array(times.wall)
    row = {"what": what, "count": len(wall), **_percentiles("wall", wall), **_percentiles("cpu", np.array(times.cpu))}
    if times.loops:
        is_full = is_full_speed(np.array(times.loops), shortest)
        row |= {"full": float(np.mean(is_full)), "full_loop_us": 1e6 * shortest, **_percentiles("full", wall[is_full])}
    return {**row, "wall_max": 1e3 * max(times.wall), **more}


def _percentiles(kind: str, seconds: np.ndarray) -> Row:
    """Those with at least one of the times beyond them."""
    shares = [
        (name, share) for name, share in zip(_NAMES, _PERCENTILES, strict=True) if len(seconds) * (100 - share) >= 100
    ]
    return {f"{kind}_{name}": float(1e3 * np.percentile(seconds, share)) for name, share in shares}


def periods(bundle: Bundle, motions: int, core: int | None, policy_core: int | None) -> Iterator[Row]:
    """Periods of motions on a fake robot in real time, and the evaluations of the policy in its own process."""
    latency, loop, policy, both, answer = _Times(), _Times(), _Times(), _Times(), _Times()
    missed, interventions = 0, 0
    shortest: list[float] = []
    for motion in range(motions):
        index = motion % len(bundle.expert)
        with measured_speed(core) as samples:  # not on the policy's own core, where it would take time from it
            robot, connection = _Robot(bundle), PolicyProcess(bundle, index, core=policy_core)
            report = run_controller(robot, bundle, index, policy=connection)
        assert not report.cause, report.cause
        ticks = bundle.periods * np.array(connection.ticks[1:])  # the first has no tick before it
        latency.wall += report.latency_s
        loop.wall += report.wall_s
        loop.cpu += report.cpu_s
        policy.wall += connection.wall_s[1:]
        policy.cpu += connection.cpu_s[1:]
        both.wall += (np.array(report.latency_s)[ticks] + connection.wall_s[1:]).tolist()
        answer.wall += connection.answer_s[1:]
        if samples:
            shortest.append(shortest_loop(samples))
            loops = loop_durations(samples, np.array(robot.times))
            latency.loops += loops.tolist()
            loop.loops += loops.tolist()
            for times in (policy, both, answer) if policy_core is None else ():
                times.loops += loops[ticks].tolist()
        missed += missed_periods(robot.states)
        interventions += sum(report.interventions.values())
    full = min(shortest, default=0.0)
    yield _row("inner loop and safety layer, to the torque", latency, full)
    yield _row("to the end of the period", loop, full, missed=missed, interventions=interventions)
    yield _row("policy, in its own process", policy, full)
    yield _row("torque and policy of a tick, together", both, full)
    yield _row("from sending an observation to its answer", answer, full)


def python_loop(core: int | None) -> Row:
    """A loop that does the same in each period."""
    times, begun = _Times(), []
    with measured_speed(core) as samples:
        for _ in range(_LOOPS):
            time.sleep(0.0005)
            started, started_cpu = time.perf_counter(), time.thread_time()
            sum(range(_LOOP))
            begun.append(started)
            times.wall.append(time.perf_counter() - started)
            times.cpu.append(time.thread_time() - started_cpu)
    if not samples:
        return _row("loop of Python alone", times)
    times.loops = loop_durations(samples, np.array(begun)).tolist()
    return _row("loop of Python alone", times, shortest_loop(samples))


def _priority() -> int:
    """The real-time priority, as `chrt -f 50` sets it; 0 for none. Processes inherit it."""
    return os.sched_getparam(0).sched_priority


def measure(bundle: Bundle, motions: int, core: int | None, policy_core: int | None) -> Iterator[Row]:
    """Rows of the table; `core` of the inner loop does not halt."""
    yield from periods(bundle, motions, core, policy_core)
    yield python_loop(core)


def main() -> None:
    parser = make_parser("deploy", __doc__, bundle=str, motions=20, awake=False, policy_core=int)
    options = parser.parse_args()
    core = min(os.sched_getaffinity(0))
    if options.policy_core == core:
        parser.error(f"--policy-core: expected another core than that of the inner loop, got {core}")
    os.sched_setaffinity(0, {core})
    with tempfile.TemporaryDirectory() as folder:
        bundle = load_bundle(options.bundle) if options.bundle else untrained_bundle(Path(folder))
        rows = measure(bundle, options.motions, core if options.awake else None, options.policy_core)
        content = {"unit": "ms", "real_time_priority": _priority()}
        content |= {"awake": options.awake, "policy_core": options.policy_core}
        collect(options, rows, "rows", _COLUMNS, **content)


if __name__ == "__main__":
    main()
