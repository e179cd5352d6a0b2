"""The pages' tables of speeds and errors of integrators: rows of cells, the header first."""

import statistics
from collections.abc import Callable

from benchmarks.common.cells import ENVIRONMENTS, Cells, Results, large, one, where


def speeds(
    kernel: Results,
    rollout: Results,
    scaling: Results,
    four: Results,
    gpu: Results,
    cpu: Results,
    startup: Results,
    pose: Results,
    mapper: Results,
    accuracy: Results,
) -> list[Cells]:
    def pairs(method: str, quantity: str) -> str:
        return large(one(kernel["results"], method=method, quantity=quantity, size=10_000_000)["pairs_per_s"])

    def both(quantity: str) -> str:
        return f"{pairs('mimic', quantity)}; {pairs('mimic, with hands', quantity)}"

    def steps(group: str, arms: int) -> str:
        return large(one(rollout["rows"], env="panda7dof", group=group, case="fused", arms=arms)["steps_per_s"])

    def to_goal(results: Results, start: str) -> str:
        values = [run["to_goal_s"] for run in where(results["runs"], start=start)]
        spread = f" ({min(values):.1f} to {max(values):.1f})" if len(values) > 1 else ""
        return f"{statistics.median(values):.1f} s{spread}"

    start = {row["what"]: row["median_s"] for row in startup["rows"]}
    poses = large(one(pose["results"], pair="panda 7->4")["methods"]["newton"]["poses_per_second"])
    goals = {run["report"]["env"]: run["to_goal_s"] for run in mapper["runs"]}
    ppo = one(scaling["rows"], devices=1)["steps_per_s"]
    several = [one(rows["rows"], processes=count) for rows, count in ((scaling, 2), (four, 4))]
    tip = one(accuracy["results"][0]["candidates"], engine="fused", substeps=10)["error_mm"]["end"]
    return [
        ("what", "measured", "target"),
        ("distance of two arms from joint motions, 7 and 7 links; with hands [pairs/s]", both("value"), "10 G"),
        ("its gradient by the learner's motion", both("gradient"), "4 G"),
        ("the same by both arms' motions", both("all"), ""),
        ("distance of links composed of `link_states` and `embodiment_distance`", pairs("composition", "value"), ""),
        (
            "physics, Panda with 7 joints, 8192; 65,536 arms [steps/s]",
            f"{steps('physics', 8192)}; {steps('physics', 65536)}",
            "60 M; 100 M",
        ),
        (
            "environment steps, 8192; 131,072 arms [steps/s]",
            f"{steps('environment', 8192)}; {steps('environment', 131072)}",
            "",
        ),
        ("PPO with learning, 4 joints [environment steps/s]", large(ppo), "2 M"),
        (
            "the same on two; four GPUs, a process each (of one GPU's speed for each)",
            "; ".join(f"{large(row['steps_per_s'])} ({row['efficiency']:.0%})" for row in several),
            "95%",
        ),
        ("process start to a gap of 2 %, one demonstration, cold", to_goal(gpu, "cold"), "20 s"),
        ("the same with a warm compilation cache", to_goal(gpu, "warm"), "10 s"),
        ("the same, cold, on two CPU cores", to_goal(cpu, "cold"), "180 s"),
        ("import of mimic, on two CPU cores", f"{start['import mimic']:.1f} s", "1.5 s"),
        ("`python -m mimic.train --help`, on two CPU cores", f"{start['mimic.train --help']:.1f} s", "3 s"),
        (
            "first `imitate_pose` of a process, 7 to 4; 7 to 7 joints, on two CPU cores [s]",
            "; ".join(f"{start[f'first imitate_pose, 7 to {joints} joints']:.2f}" for joints in (4, 7)),
            "1.2 s",
        ),
        ("optimal poses, Panda 7 to 4 [poses/s]", poses, "1 M"),
        (
            "process start to a pose mapper within 2 %, 4; 7; 3 joints [s]",
            "; ".join(f"{goals[env]:.1f}" for env in ("panda4dof", "panda7dof", "panda3dof")),
            "10 s",
        ),
        (
            "error of the tip after 5 s of random torques, median; 95 % [mm]",
            f"{tip['median']:.2f}; {tip['p95']:.2f}",
            "1 mm",
        ),
    ]


PPO_CASES = {
    "mimic, fused": "`env.physics=fused`",
    "brax's loop, fused": "brax's own training loop, on the same environment",
    "mimic, mjx": "`env.physics=mjx`",
    "brax's loop, mjx.Data carried": "brax's own training loop, on an environment that carries `mjx.Data`",
}


def ppo(gpu: Results, cpu: Results) -> list[Cells]:
    def speed(results: Results, case: str) -> str:
        (row,) = where(results["rows"], case=case) or [{}]
        return large(row["steps_per_s"]) if "steps_per_s" in row else ""

    rows: list[Cells] = [("environment steps/s", "H200", "two CPU cores")]
    return [*rows, *((name, speed(gpu, case), speed(cpu, case)) for case, name in PPO_CASES.items())]


def physics(rollout: Results) -> list[Cells]:
    def cell(group: str, case: str, key: str, form: Callable[[float], str]) -> str:
        (row,) = where(rollout["rows"], env="panda7dof", group=group, case=case, arms=8192) or [{}]
        return form(row[key]) if row.get(key) else ""

    names = {
        "`env.physics=fused`": ("fused", "fused"),
        "`env.physics=mjx`": ("mjx", "mjx"),
        "`mjx.Data` carried from step to step, reset by brax's wrappers": ("mjx.Data carried", "stock"),
        "C MuJoCo, all cores": ("C MuJoCo, all cores", ""),
    }
    rows: list[Cells] = [("", "physics, steps/s", "environment steps/s", "device memory of an arm")]
    for name, (case, environment) in names.items():
        memory = cell("environment", environment, "bytes_per_arm", lambda size: f"{size / 1000:.1f} kB")
        rates = cell("physics", case, "steps_per_s", large), cell("environment", environment, "steps_per_s", large)
        rows.append((name, *rates, memory))
    return rows


def integrators(accuracy: Results) -> list[Cells]:
    candidates = (
        (50, "euler", "mujoco"),
        (2, "rk4", "mujoco"),
        (5, "rk4", "mujoco"),
        (10, "rk4", "mujoco"),
        (20, "rk4", "mujoco"),
        (10, "rk4", "mjx"),
        (10, "rk4", "fused"),
    )
    results = {row["env"]: row["candidates"] for row in accuracy["results"]}

    def error(env: str, substeps: int, integrator: str, engine: str) -> str:
        end = one(results[env], substeps=substeps, integrator=integrator, engine=engine)["error_mm"]["end"]
        return " / ".join(
            "-" if end[key] is None else f"{end[key]:.2g}" if end[key] < 100 else f"{end[key]:.0f}"
            for key in ("median", "p95", "max")
        )

    rows: list[Cells] = [("steps in 0.1 s", "integrator", "engine", "7 joints", "4 joints", "3 joints")]
    for substeps, integrator, engine in candidates:
        errors = [error(env, substeps, integrator, engine) for env in ENVIRONMENTS]
        rows.append((str(substeps), {"euler": "Euler", "rk4": "Runge-Kutta"}[integrator], engine, *errors))
    return rows
