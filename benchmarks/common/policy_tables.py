"""The pages' tables of poses and policies of one pair of arms: rows of cells, the header first."""

import statistics

from benchmarks.common.cells import (
    ENVIRONMENTS,
    MEASURES,
    SIMILARITY_HEADER,
    Cells,
    Results,
    large,
    one,
    percent,
    span,
    split_pair,
    where,
)

HAND_ROTATION = "hand_rotation_deg"
SPLITS = {"train": "training", "held_out": "held out"}

# Poses


def pose_methods(pose: Results) -> list[Cells]:
    names = {
        "newton": "`imitate_pose`",
        "paper": "gradient descent, one initial guess (paper)",
        "mink": "mink, on the CPU",
    }
    rows: list[Cells] = [("pair", "method", "above the best known", "global minimum", "poses/s")]
    for result in sorted(pose["results"], key=lambda result: result["pair"], reverse=True):
        for method, name in names.items():
            row = result["methods"][method]
            quality, fraction, rate = row["quality"], row["global_share"], row["poses_per_second"]
            rows.append((result["pair"], name, percent(abs(quality)), percent(fraction, ".1f"), large(rate)))
    return rows


def mapper_presets(mapper: Results) -> list[Cells]:
    pairs = {env: f"Panda {pair}" for env, pair in ENVIRONMENTS.items()}
    pairs |= {"planar4dof": "planar 7 to 4", "planar7dof": "planar 4 to 7"}
    rows: list[Cells] = [("pair", "`paper`, training", "`paper`, unseen", "`large`, unseen")]
    reports = {(run["preset"], run["report"]["env"]): run["report"]["quality"] for run in mapper["runs"]}
    for env, pair in pairs.items():
        paper, wide = reports["paper", env], reports["large", env]
        rows.append((pair, percent(paper["train"]), percent(paper["held_out"]), percent(wide["held_out"])))
    return rows


# Dynamic imitation


def simulations(paper: Results, others: Results) -> list[Cells]:
    """Gaps of the paper's three simulations in its setting, mean and standard deviation over the seeds."""
    rows: list[Cells] = [
        ("joints", "trained on", *(f"{name}, {x}" for name in ("mimic", "SB3") for x in SPLITS.values()))
    ]
    cases = [("one_demonstration", "7 to 7", "1"), *((env, joints, "124") for env, joints in ENVIRONMENTS.items())]
    for case, joints, count in cases:
        gaps = [run["optimality_gap"] for run in paper["results"][f"{case}-paper"]]
        of_others = [row["gap"] for row in where(others["rows"], task=case)]
        values = ([100 * of_seed[split] for of_seed in seeds] for seeds in (gaps, of_others) for split in SPLITS)
        rows.append((joints, count, *(f"{statistics.fmean(x):.2f} ± {statistics.stdev(x):.2f}" for x in values)))
    return rows


def unseen_motions(motions: Results) -> list[Cells]:
    """Gap of the policy and of controllers without learning on motions from the home pose, by environment."""
    controllers = {row["controller"] for row in motions["rows"]}
    known = ("copy_joints", "one_step", "nearest_pose", "mpc", "computed_torque", "whole_motion")
    names = [name for name in known if name in controllers]
    rows: list[Cells] = [("joints", "motions", "policy: gap, 95 % interval [%]", *(f"`{name}`" for name in names))]
    keys = dict.fromkeys((row["env"], row["set"], row["kind"]) for row in motions["rows"] if row["set"] != "new")
    for env, which, kind in keys:
        found = where(motions["rows"], env=env, set=which, kind=kind)
        gaps = {row["controller"]: row for row in found if row["gap"] is not None}
        if "policy" in gaps:
            others = (f"{100 * gaps[name]['gap']:.2f}" if name in gaps else "" for name in names)
            label = f"{which}: {kind.replace('_', ' ')}"
            gap, low, high = (f"{100 * gaps['policy'][key]:.2f}" for key in ("gap", "low", "high"))
            rows.append((ENVIRONMENTS[env].split()[-1], label, f"{gap}, {low} to {high}", *others))
    return rows


def motions_from_anywhere(motions: Results) -> list[Cells]:
    """Mean distance above the bound, in thousandths, on kinds of motions that no training has, by environment."""
    names = "policy", "nearest_pose", "computed_torque", "whole_motion"
    rows: list[Cells] = [("joints", "motions", "holding still", "policy", *(f"`{name}`" for name in names[1:]))]
    new = where(motions["rows"], set="new")
    for env, kind in dict.fromkeys((row["env"], row["kind"]) for row in new):
        of_kind = {row["controller"]: row for row in where(new, env=env, kind=kind)}
        excess = [of_kind[name]["excess"] if name in of_kind else None for name in names]
        cells = ("" if x is None else f"{1000 * x:.1f}" for x in (of_kind["policy"]["excess_of_holding"], *excess))
        rows.append((ENVIRONMENTS[env].split()[-1], kind.replace("_", " "), *cells))
    return rows


def overview(motions: Results, pose: Results) -> list[Cells]:
    """The table of the README: interval of the policy's gap on each kind of test motions, and poses per second."""
    rate = large(one(pose["results"], pair="panda 7->4")["methods"]["newton"]["poses_per_second"])
    test = where(motions["rows"], set="test", controller="policy")
    rows: list[Cells] = [("test motions", *(f"{pair.split()[-1]} joints" for pair in ENVIRONMENTS.values()))]
    for kind in dict.fromkeys(row["kind"] for row in test):
        gaps = {row["env"]: f"{100 * row['low']:.2f}–{100 * row['high']:.2f}" for row in where(test, kind=kind)}
        rows.append((f"`{kind}` [%]", *(gaps[env] for env in ENVIRONMENTS)))
    return [*rows, ("poses at their optimum per second", "", rate, "")]


def main_results(training: Results, pose: Results, mapper: Results, any_arm: Results, hardware: Results) -> list[Cells]:
    def measure(name: str, measure: str) -> float:
        runs = where(training["rows"], env="panda4dof")
        return statistics.fmean(run["similarity"][name][measure]["held_out"] for run in runs)

    ppo = ", ".join(
        span([run["optimality_gap"]["held_out"] for run in where(training["rows"], env=env)]) for env in ENVIRONMENTS
    )
    lines, hands = ([measure(name, key) for name in ("policy", "copy_joints")] for key in (MEASURES[0], HAND_ROTATION))
    newton = one(pose["results"], pair="panda 7->4")["methods"]["newton"]
    network = next(run for run in mapper["runs"] if run["report"]["env"] == "panda4dof")
    quality = percent(network["report"]["quality"]["held_out"], ".1f")
    gaps = [
        statistics.fmean(arm["gap"] for arm in any_arm[group] if arm["span"] >= 0.25) for group in ("locks", "real")
    ]
    robots = [run[loop] for run in hardware["runs"] for loop in ("virtual", "ruckig")]
    episodes, aborts = (sum(run[key] for run in hardware["runs"]) for key in ("episodes", "aborts"))
    return [
        ("result", "page"),
        (
            f"PPO has held-out gaps of {ppo} % with 7, 4, 3 joints; 0 is the kinematic bound, 100 % holding the start "
            "pose.",
            "[dynamic motions](dynamic_imitation.md#motions-of-several-kinds)",
        ),
        (
            f"Its centre line is {lines[0]:.3f} chain lengths from the expert's with 4 joints, its hand {hands[0]:.0f} "
            f"deg; copying shared joints has {lines[1]:.3f} and {hands[1]:.0f} deg.",
            "[similarity](dynamic_imitation.md#similarity)",
        ),
        (
            f"`imitate_pose` finds the global minimum of {percent(newton['global_share'], '.1f')} of poses, "
            f"{large(newton['poses_per_second'])} a second on an H200. A pose mapper makes "
            f"{large(network['poses_per_second'])}, {quality} above.",
            "[static poses](static_pose_imitation.md#comparison-with-other-methods)",
        ),
        (
            f"A controller without training has gaps of {percent(gaps[0], '.1f')} on locked Pandas, "
            f"{percent(gaps[1], '.1f')} on real arms.",
            "[any arm](any_arm.md#a-controller-without-training)",
        ),
        (
            f"On virtual robots policies have gaps of {span(robots)} %, and {aborts} of {episodes:,} episodes were "
            "aborted. None was on hardware.",
            "[the hardware world](hardware_world.md#results)",
        ),
    ]


def policy_similarity(training: Results) -> list[Cells]:
    forms = (".3f", ".1f", ".3f", ".3f", ".1f", ".1f")
    names = {
        "policy": "**policy**",
        "nearest_poses": "nearest poses",
        "copy_joints": "copying shared joints",
        "hand_ik": "IK of the scaled hand",
    }
    runs = where(training["rows"], env="panda4dof")
    rows: list[Cells] = [("7 to 4", *SIMILARITY_HEADER, "hand rotation")]
    for name, label in names.items():
        cells = [label]
        for measure, form in zip((*MEASURES, HAND_ROTATION), forms, strict=True):
            values = [run["similarity"][name][measure] for run in runs]
            means = {split: statistics.fmean(value[split] for value in values) for split in ("train", "held_out")}
            cells.append(split_pair(means, form, 1))
        rows.append(cells)
    return rows


def pretrained(files: Results) -> list[Cells]:
    reports = {path.split("/")[-2]: report for path, report in files.items()}
    policy, mapper = "policy: gap, training / held out", "mapper: gap"
    rows: list[Cells] = [("environment", policy, "distance / bound / copying", mapper, "distance / optimum / copying")]
    for env in ("panda3dof", "panda4dof", "panda7dof", "planar4dof", "planar7dof"):
        cells = [f"`{env}`"]
        for network, quality, best in (
            ("policy", "optimality_gap", "lower_bound"),
            ("pose_mapper", "quality", "optimal_distance"),
        ):
            report = reports[f"{env}-{network}"]
            gap = (
                split_pair(report[quality], ".1f")
                if network == "policy"
                else f"{100 * report[quality]['held_out']:.2f}"
            )
            distances = [report[key]["held_out"] for key in ("mean_distance", best, "copying_distance")]
            cells += [f"{gap} %", " / ".join(f"{distance:.3f}" for distance in distances)]
        rows.append(cells)
    return rows


def exact_hands(results: Results) -> list[Cells]:
    """Means over all frames of each arm's demonstrations; the speed is the maximum."""
    rows: list[Cells] = [("arm", "method", "exact", "speed", "elbow", "plane [deg]")]
    names = {"ur5e": "UR5e", "fr3": "FR3"}
    for arm, method in dict.fromkeys((row["learner"], row["method"]) for row in results["motions"]):
        motions = where(results["motions"], learner=arm, method=method)
        frames = sum(row["frames"] for row in motions)
        exact, elbow, plane = (
            sum(row[key] * row["frames"] for row in motions) / frames for key in ("exact", "elbow", "plane_deg")
        )
        fastest = max(row["fastest"] for row in motions)
        rows.append((names[arm], method, percent(exact, ".1f"), f"{fastest:.1f}", f"{elbow:.3f}", f"{plane:.1f}"))
    return rows


# Similarity


CANDIDATES = {
    "hand_ik": "hand IK",
    "kept arc_length 0": "links kept, arc length, 0",
    "kept arc_length 1": "**links kept, arc length, 1**",
    "kept arc_length 2": "links kept, arc length, 2",
    "kept overlap 1": "links kept, overlap, 1",
    "merged overlap 0": "links merged, overlap, 0",
}


def _candidates(summary: Results, baseline: str) -> list[Cells]:
    rows: list[Cells] = [("", *SIMILARITY_HEADER)]
    for name, label in CANDIDATES.items():
        if name in summary and name != baseline:
            entries = [summary[name][measure] for measure in MEASURES]
            rows.append((label, *(f"{entry['ratio']:.2f} ({entry['lost']})" for entry in entries)))
    return rows


def metrics_by_locks(results: Results) -> list[Cells]:
    return _candidates(results["summary"]["locks, demonstrations, to copy_joints"], "copy_joints")


def metrics_by_arms(results: Results) -> list[Cells]:
    return _candidates(results["summary"]["other arms, demonstrations, to hand_ik"], "hand_ik")


def hand_weights(results: Results) -> list[Cells]:
    groups = {"locks": "Panda with one or two joints locked", "other arms": "the Panda and six other arms"}
    summaries = [results["summary"][f"{group}, demonstrations, to no weight"] for group in groups]
    measures = {"centre_line_distance": "centre line", "hand_rotation_deg": "hand rotation"}
    rows: list[Cells] = [("weight", *(f"{arms}: {name}" for arms in groups.values() for name in measures.values()))]
    for method in (name for name in summaries[0] if name.startswith("hand 0.")):
        ratios = [f"{summary[method][measure]['ratio']:.2f}" for summary in summaries for measure in measures]
        rows.append((method.removeprefix("hand "), *ratios))
    return rows


def hand_postures(results: Results) -> list[Cells]:
    groups = {"locks": "locked", "other arms": "other arms"}
    summaries = [results["summary"][f"{group}, demonstrations, to no weight"] for group in groups]
    measures = {"elbow": "elbow", "wrist": "wrist", "plane_deg": "plane"}
    rows: list[Cells] = [("weight", *(f"{arms}: {name}" for arms in groups.values() for name in measures.values()))]
    for method in ("hand 0.01", "hand 0.02", "hand 0.05"):
        ratios = [f"{summary[method][measure]['ratio']:.2f}" for summary in summaries for measure in measures]
        rows.append((method.removeprefix("hand "), *ratios))
    return rows


def default_metric(results: Results) -> list[Cells]:
    cases = {
        "locks, demonstrations, to copy_joints": ("Panda with one or two joints locked", "copying joints"),
        "other arms, demonstrations, to hand_ik": ("the Panda and six other arms, both ways", "IK of the hand"),
    }
    rows: list[Cells] = [("learner", "compared with", *SIMILARITY_HEADER, "hand rotation")]
    for case, (learner, baseline) in cases.items():
        entry = results["summary"][case]["hand 0.02"]
        ratios = [f"{entry[measure]['ratio']:.2f}" for measure in (*MEASURES, HAND_ROTATION)]
        rows.append((f"{learner}, {entry['cases']} cases", baseline, *ratios))
    return rows
