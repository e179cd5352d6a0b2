"""The pages' tables of any arm, robots and motion capture: rows of cells, the header first."""

import statistics
from collections.abc import Callable
from typing import Any

from benchmarks.common.cells import MEASURES, Cells, Results, device, one, percent, span, where

# Any arm


def any_arm_controller(named: Results, random: Results) -> list[Cells]:
    rows: list[Cells] = [
        (
            "arms",
            "gap [%], mean",
            "median",
            "maximum",
            "second half",
            "centre line: controller / bound's poses / holding",
        )
    ]
    arms = {
        "Pandas with one or two joints locked": named["locks"],
        "real arms": named["real"],
        "random arms": random["random"],
    }
    for name, group in arms.items():
        kept = [arm for arm in group if arm["span"] >= 0.25]
        gaps = [100 * arm["gap"] for arm in kept]
        late = 100 * statistics.fmean(arm["late"] for arm in kept)
        lines = [statistics.fmean(arm[f"{who}centre_line_distance"] for arm in kept) for who in ("", "best_", "hold_")]
        numbers = (statistics.fmean(gaps), statistics.median(gaps), max(gaps), late)
        cells = [f"{number:.1f}" for number in numbers]
        rows.append((f"{len(kept)} {name}", *cells, " / ".join(f"{line:.3f}" for line in lines)))
    return rows


def unseen_arms(results: Results) -> list[Cells]:
    ways = {
        "one policy that has not seen this arm": "unseen",
        "one policy that has": "seen",
        "controller, no training": "controller",
        "PPO of this arm alone": "alone",
    }
    rows: list[Cells] = [("held-out gap [%]", *(row["arm"] for row in results["rows"]))]
    for label, key in ways.items():
        gaps = (row[key] for row in results["rows"])
        rows.append((label, *("" if gap is None else f"{100 * gap:.1f}" for gap in gaps)))
    return rows


def locked_arms(results: Results) -> list[Cells]:
    """Gaps of one policy and of the controller without learning by number of locked joints, of arms that have a gap."""
    (run,) = results["results"]["panda_family"]
    rows: list[Cells] = [
        ("locked joints", "arms", "controller, no training: mean, largest gap [%]", "policy: mean, largest gap [%]")
    ]
    for seen, label in ((True, "in training"), (False, "not in training")):
        of_split = [arm for arm in run["arms"].values() if arm["seen"] == seen and arm["gap"] is not None]
        for joints in sorted({arm["joints"] for arm in of_split}, reverse=True):
            arms = [arm for arm in of_split if arm["joints"] == joints]
            gaps = [[100 * arm[key] for arm in arms] for key in ("controller_gap", "gap")]
            cells = (f"{statistics.fmean(values):.2f}, {max(values):.2f}" for values in gaps)
            rows.append((f"{7 - joints}, {label}", str(len(arms)), *cells))
    return rows


# Robots


JOINTS = {"panda7dof": "7 joints", "panda4dof": "4 joints"}


def hardware_policies(results: Results) -> list[Cells]:
    header = (
        "gap [%]",
        "training's physics",
        "MJX",
        "virtual robot",
        "with Ruckig's loop",
        "worst range at its end",
        "all ranges at their ends",
    )
    rows: list[Cells] = [header]
    for env, joints in JOINTS.items():
        runs = where(results["runs"], run=env)
        gaps = [span([run[key] for run in runs]) for key in ("fused", "mjx", "virtual", "ruckig")]
        edges = [span([run[key] for run in runs if key in run]) for key in ("edges_worst", "edges_together")]
        rows.append((joints, *gaps, *edges))
    return rows


def hardware_tracking(results: Results) -> list[Cells]:
    rows: list[Cells] = [
        ("held-out gap [%]", "tracking", "tracking that knows the reference as late as a policy observes it", "PPO")
    ]
    for env, joints in JOINTS.items():
        runs = where(results["runs"], run=env)
        first = one(runs, seed=0)
        rows.append(
            (joints, f"{100 * first['tracking']:.2f}", f"{100 * first['late']:.2f}", span([r["fused"] for r in runs]))
        )
    return rows


UNKNOWN = {
    "history": "policy with history",
    "present": "without",
    "links": "policy that sees links",
    "points": "points alone",
    "nominal": "computed torque, data sheet",
    "observer": "corrected",
    "true": "computed torque, true model",
}
UNKNOWN_SETS = {"none": "nothing", "compensation": "gravity compensation", "all": "all of them"}


def unknown(results: Results) -> list[Cells]:
    measured = {row["controller"] for row in results["rows"]}
    columns = {key: label for key, label in UNKNOWN.items() if key in measured}
    rows: list[Cells] = [("unknown, gap [%]", *columns.values())]
    for name in dict.fromkeys(row["set"] for row in results["rows"]):
        of_set = [one(results["rows"], set=name, controller=controller) for controller in columns]
        rows.append((UNKNOWN_SETS.get(str(name), str(name)), *(f"{100 * row['gap']:.2f}" for row in of_set)))
    return rows


# Motion capture


METHODS = {
    "mimic": "`imitate_trajectory`",
    "mimic_hand": "with the hand cost",
    "pose_mapper": "pose mapper",
    "frame_matching": "GMR's way",
    "hand_ik": "IK of the hand",
}


def captured_similarity(results: Results) -> list[Cells]:
    rows: list[Cells] = [("robot", *METHODS.values())]
    for learner in ("panda", "panda -3,6,7", "UR5e", "IIWA"):
        cells = [learner]
        for method in METHODS:
            arms = where(results["results"], learner=learner, method=method)
            line, tangent, _, hand, _ = (statistics.fmean(arm[measure] for arm in arms) for measure in MEASURES)
            cells.append(f"{line:.3f}; {tangent:.1f}; {hand:.3f}")
        rows.append(cells)
    return rows


def captured_methods(results: Results) -> list[Cells]:
    rows: list[Cells] = [("method", "speed [rad/s]", "jerk [rad/s<sup>3</sup>]")]
    for method, name in METHODS.items():
        entries = where(results["results"], method=method)
        speed = max(entry["largest_speed"] for entry in entries)
        jerk = statistics.median(entry["jerk_rms"] for entry in entries)
        rows.append((name, f"{speed:.0f}", f"{jerk:,.0f}"))
    return rows


def two_arms(results: Results) -> list[Cells]:
    numbers = {
        "minimum distance of capsules of different arms [m]": ("between_arms_minimum_m", ".3f"),
        "of the same arm [m]": ("within_arm_minimum_m", ".3f"),
        "samples with arms closer than 2 cm to each other": ("between_arms_closer", ".1%"),
        "samples with an arm closer than 2 cm to itself": ("within_arm_closer", ".1%"),
        "distance of the centre lines [chain lengths]": ("centre_line_distance", ".3f"),
        "angle of the tangents [deg]": ("tangent_angle_deg", ".0f"),
    }
    pair = [one(results["results"], cost=cost) for cost in ("without", "with")]
    return [
        ("", "without", "with"),
        *((name, *(format(row[key], f) for row in pair)) for name, (key, f) in numbers.items()),
    ]


def captured_policies(results: Results) -> list[Cells]:
    rows: list[Cells] = [("clip", "arm", "robot", "seeds", "training", "held out", "distance: bound, policy, holding")]
    cases = dict.fromkeys((run["clip"], run["arm"], run["learner"]) for run in results["results"])
    for clip, arm, learner in cases:
        runs = where(results["results"], clip=clip, arm=arm, learner=learner)
        gaps = [span([run["gap"][split] for run in runs], ".1f") for split in ("train", "held_out")]
        keys = ("kinematic_bound", "mean_distance", "hold_distance")
        distances = [span([run[key]["held_out"] for run in runs], ".3f", 1) for key in keys]
        rows.append((clip, arm, learner, str(len(runs)), *gaps, ", ".join(distances)))
    return rows


# Data sets of other arms


def transfers(results: Results, *replays: Results) -> list[Cells]:
    """Demonstrations on each arm: how many keep all hands, and how many succeed in robosuite by each method."""
    physics = [row for replayed in (results, *replays) for row in replayed["physics"]]
    titles = {"mimic": "succeed in robosuite", "ssik": "ssik", "mink": "mink", "copied": "joints copied"}
    methods = [method for method in titles if where(physics, method=method)]
    rows: list[Cells] = [("arm", "exact in all frames", "frames", *(titles[method] for method in methods))]
    learners = list(dict.fromkeys(row["learner"] for row in results["pairs"]))
    for name in [learners, *([learner] for learner in learners)]:
        pairs = [row for row in results["pairs"] if row["learner"] in name]
        frames = sum(row["exact"] for row in pairs) / sum(row["frames"] for row in pairs)
        of_arm = [row for row in physics if row["learner"] in name]
        succeed = [sum(row["success"] for row in where(of_arm, method=method)) for method in methods]
        exact = sum(row["exact"] == row["frames"] for row in pairs)
        counts = [f"{count} of {len(pairs)}" for count in (exact, *succeed)]
        rows.append((name[0] if len(name) == 1 else "all", counts[0], percent(frames), *counts[1:]))
    return rows


def transfer_speeds(*measured: Results) -> list[Cells]:
    """How fast data sets are retargeted, by compiled functions and by a command without a compilation cache."""
    header = "arm", "on", "frames", "exact", "frames/s", "command, without compiled functions"
    rows: list[Cells] = [header]
    for results in measured:
        for row in results["rows"]:
            frames, speed = (f"{row[key]:,.0f}" for key in ("frames", "frames_per_s"))
            command = f"{row['command_s']:.0f} s for {row['command_frames']:,} frames"
            rows.append((row["learner"], device(results), frames, percent(row["exact"]), speed, command))
    return rows


def transferred_teleoperation(results: Results) -> list[Cells]:
    rows: list[Cells] = [("mapping", "hand's direction, mean [deg]", "hand's position, median / 95 % [mm]")]
    for row in results["teleoperation"]:
        places = f"{row['position_mm_p50']:.1f} / {row['position_mm_p95']:.1f}"
        rows.append((row["method"], f"{row['hand_direction_deg']:.1f}", places))
    return rows


def ticks(teleoperation: Results) -> list[Cells]:
    """Times, errors and limits of live followers by method."""
    times = teleoperation["times"]
    percentiles = {"p50_ms": "p50", "p99_ms": "p99", "p999_ms": "p99.9"}
    cells: dict[str, Callable[[Any], str]] = {
        f"tick, {' / '.join(percentiles.values())} [ms]": lambda row: " / ".join(
            f"{row[key]:.2f}" for key in percentiles
        ),
        "hand, p50 / p95 [mm]": lambda row: f"{row['position_mm_p50']:.1f} / {row['position_mm_p95']:.0f}",
        "acceleration or jerk over its limit": lambda row: f"{row['of_limits']:.1f}",
        "plane of shoulder, elbow and wrist [deg]": lambda row: f"{row['plane_deg']:.1f}",
    }
    rows = [(name, *(cell(row) for row in times)) for name, cell in cells.items()]
    return [("SO-101 to Piper", *(row["method"] for row in times)), *rows]


def live_postures(teleoperation: Results) -> list[Cells]:
    """Hands and postures of arms with seven joints that follow a Panda, by method."""
    found = {(row["follower"], row["method"]): row for row in teleoperation["postures"]}
    followers, methods = (dict.fromkeys(key[index] for key in found) for index in (0, 1))
    cells = {
        (follower, method): f"{row['position_mm_p95']:.1f}; {row['elbow']:.3f}; {row['plane_deg']:.1f}"
        for (follower, method), row in found.items()
    }
    rows = [(follower, *(cells[follower, method] for method in methods)) for follower in followers]
    return [("Panda to", *methods), *rows]
