"""`python -m mimic.inspect`: shows the joints, links and limits of an arm, and how closely it can imitate."""

import dataclasses
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from mimic.arms.arm import Arm, ArmConfig, finite_velocity_limit, torque_scale, with_full_keys
from mimic.arms.rendering import ArmScene
from mimic.arms.simulation_model import effective_inertia
from mimic.base.config import new_path
from mimic.commands import arm_checks
from mimic.commands.config import InspectConfig, base_numbers
from mimic.commands.hand_reach import (
    HandReach,
    hand_reach,
    plot_reach,
    reach_lines,
    reach_table,
)
from mimic.commands.printed import say, train_command
from mimic.envs.config import EnvConfig
from mimic.evaluation.rollout_metrics import pose_similarity
from mimic.motions.demonstrations import Demonstrations
from mimic.runs.files import write_report
from mimic.trainers.progress import similarity_table

_PICTURE, _RESULTS = "arms.png", "inspection.json"
_SCENE = 800, 640  # pixels


def prepare_inspection(config: InspectConfig) -> Callable[[], None]:
    """Checks the config of an inspection and builds both arms.

    Raises:
      ValueError: an arm cannot be trained, the expert's limits permit no goal, `out` exists, or OpenGL is not available
        for the pictures.
    """
    out = new_path("out", config.out) if config.out else None
    env = EnvConfig(name="pair", expert=config.expert, learner=config.learner, limits=config.limits)
    expert, learner = env.build_arms()
    demonstrations = arm_checks.sample_demonstrations(expert, env) if config.bound else None
    match = env.metric.match_links(expert.embodiment, learner.embodiment)
    arms, colours = [config.expert, config.learner], [match.expert_colours, match.learner_colours]
    scene = ArmScene(arms, limits=config.limits, width=_SCENE[0], height=_SCENE[1], colours=colours) if out else None

    def run() -> None:
        console = Console()
        results, reach = _inspect(config, env, expert, learner, demonstrations)
        _print(console, results, reach, expert, learner, is_searched=config.base == "auto")
        if out and scene:
            out.mkdir()
            home = [np.asarray(expert.embodiment.home), np.asarray(learner.embodiment.home)]
            with scene:
                scene.fit([pose[None] for pose in home])
                image = scene.image(home)
            _save_picture(out / _PICTURE, image, expert, learner, env, reach)
            write_report(out, results, _RESULTS)
            say(console, f"results: {out}")
        say(console, f"train it: {results['train']}")

    return run


def _inspect(
    config: InspectConfig, env: EnvConfig, expert: Arm, learner: Arm, demonstrations: Demonstrations | None
) -> tuple[dict[str, Any], HandReach | None]:
    """The content of inspection.json, and what the hand keeps; without demonstrations no distance and no hand."""
    stable_config, reason = arm_checks.stabilised(config.learner, learner, env)
    reachable = similarity = reach = None
    if demonstrations is not None:
        reachable = arm_checks.reachable_distance(expert, learner, env, demonstrations)
        nearest = {"nearest_poses": reachable.nearest_qpos}
        similarity = pose_similarity(expert.embodiment, learner.embodiment, reachable.expert_qpos, nearest)
        if all(arm.embodiment.hand_joint for arm in (expert, learner)):
            base = "auto" if config.base == "auto" else base_numbers(config.base)
            reach = hand_reach(config.expert, config.learner, env.metric, base)
    results = {
        "arm": learner.embodiment.name,
        "expert": expert.embodiment.name,
        "joints": _joints(learner, config.learner, env),
        "links": _links(expert, learner, env),
        "ends": [with_full_keys(end.reason, "learner") for end in learner.ends],
        "ignored": list(learner.notes),
        "assumed": list(arm_checks.assumptions(config.learner, learner)),
        "warnings": [
            *arm_checks.hand_doubts("expert", expert),
            *arm_checks.warnings(config.learner, learner),
            *([reason] if reason else []),
        ],
        "bound": reachable and reachable.bound,
        "hold": reachable and reachable.hold,
        "similarity": similarity,
        "hand": reach and reach.summary(),
        "train": train_command(dataclasses.replace(env, learner=stable_config)),
    }
    return results, reach


def _print(
    console: Console, results: dict[str, Any], reach: HandReach | None, expert: Arm, learner: Arm, *, is_searched: bool
) -> None:
    say(console, _headline(expert, learner))
    console.print(_table(f"joints of {results['arm']}", results["joints"]))
    console.print(_table("links, and the expert links that they are compared with", results["links"]))
    for label, key in (("ends at", "ends"), ("ignored", "ignored"), ("assumed", "assumed"), ("warning", "warnings")):
        say(console, *(f"{label}: {line}" for line in results[key]))
    if results["similarity"] is not None:
        say(console, _distance_line(results))
        console.print(similarity_table(results["similarity"]))
    if reach is not None:
        pair = expert.embodiment, learner.embodiment
        console.print(reach_table(reach, pair))
        say(console, *reach_lines(reach, pair, is_searched=is_searched))


def _joints(arm: Arm, config: ArmConfig, env: EnvConfig) -> list[dict[str, Any]]:
    embodiment = arm.embodiment
    columns = {
        "range": arm_checks.joint_ranges(config, arm).tolist(),
        "rated speed": finite_velocity_limit(embodiment).tolist(),
        "speed is assumed": (~np.isfinite(embodiment.velocity_limit)).tolist(),
        "torque limit": [float(x) if np.isfinite(x) else None for x in embodiment.torque_limit],
        "torque offered": torque_scale(arm, env.action_scale, env.control_dt).tolist(),
        "inertia": effective_inertia(arm.model, np.asarray(embodiment.home)).tolist(),
    }
    free = [
        {"joint": name, "held at": None, **dict(zip(columns, row, strict=True))}
        for name, *row in zip(embodiment.joint_names, *columns.values(), strict=True)
    ]
    return free + [{"joint": name, "held at": angle} for name, angle in arm.locked.items()]


def _links(expert: Arm, learner: Arm, env: EnvConfig) -> list[dict[str, Any]]:
    arm, fractions = learner.embodiment, env.metric.link_fractions(expert.embodiment, learner.embodiment)
    return [
        {
            "link": name,
            "length": float(arm.link_lengths[index]),
            "moved by": arm.joint_names[arm.link_joint[index]] if arm.link_joint[index] >= 0 else "nothing",
            "compared with": {
                expert_link: float(fraction)
                for expert_link, fraction in zip(expert.embodiment.link_names, fractions[:, index], strict=True)
                if fraction > 0
            },
        }
        for index, name in enumerate(arm.link_names)
    ]


_HEADERS = {  # of the tables, by the keys of inspection.json
    "range": "range\n[rad]", "rated speed": "velocity limit\n[rad/s]", "torque limit": "torque limit\n[N m]",
    "torque offered": "action torque\n[N m]", "inertia": "inertia\n[kg m^2]", "length": "length\n[m]",
    "held at": "locked at\n[rad]",
}  # fmt: skip


def _table(title: str, rows: list[dict[str, Any]]) -> Table:
    hidden = {"speed is assumed"} | {key for key in ("held at",) if all(row.get(key) is None for row in rows)}
    keys = [key for key in rows[0] if key not in hidden]
    table = Table(title=title, title_justify="left")
    for key in keys:  # names are never wrapped
        table.add_column(escape(_HEADERS.get(key, key)), no_wrap=key in ("joint", "link", "moved by"))
    for row in rows:
        assumed = {"rated speed"} if row.get("speed is assumed") else set()
        table.add_row(*(escape(_text(row.get(key)) + (" assumed" if key in assumed else "")) for key in keys))
    return table


def _text(value: Any) -> str:
    if value is None:
        return "-"
    if isinstance(value, dict):
        return ", ".join(f"{name} {fraction:.0%}" for name, fraction in value.items())
    if isinstance(value, list):
        return " to ".join(f"{x:.2f}" for x in value)
    return f"{value:.3g}" if isinstance(value, float) else str(value)


def _headline(expert: Arm, learner: Arm) -> str:
    arm, expert_arm = learner.embodiment, expert.embodiment
    return (
        f"{arm.name}: {arm.num_joints} joints, {arm.num_links} links, {arm.chain_length:.3f} m along them, "
        f"{learner.model.body_mass.sum():.2f} kg of moving mass; expert {expert_arm.name}: "
        f"{expert_arm.num_joints} joints, {expert_arm.num_links} links, {expert_arm.chain_length:.3f} m"
    )


def _distance_line(results: dict[str, Any]) -> str:
    bound, hold = results["bound"], results["hold"]
    return (
        f"distance on random demonstrations of {results['expert']}: {bound:.3f} for the best poses, {hold:.3f} "
        f"for holding the start pose; imitation can reduce it by {1 - bound / hold:.0%}"
    )


def _save_picture(
    path: Path, image: np.ndarray, expert: Arm, learner: Arm, env: EnvConfig, reach: HandReach | None
) -> None:
    """Draws both arms in their start poses, the correspondence of their links, and what the hand keeps, if known."""
    rows = 1 if reach is None else 2
    figure = Figure(figsize=(13, 5.6 * rows), layout="constrained")
    axes = figure.subplots(rows, 2, width_ratios=(1.35, 1), squeeze=False)
    _draw_links(axes[0, 0], axes[0, 1], image, expert, learner, env)
    if reach is not None:
        plot_reach((axes[1, 0], axes[1, 1]), reach, (expert.embodiment, learner.embodiment))
    figure.savefig(path, dpi=100)


def _draw_links(left: Axes, right: Axes, image: np.ndarray, expert: Arm, learner: Arm, env: EnvConfig) -> None:
    """Draws both arms, and the correspondence of their links as a matrix of fractions."""
    left.imshow(image)
    left.axis("off")
    names = f"{expert.embodiment.name} (expert), {learner.embodiment.name} (learner)"
    left.text(0.5, -0.02, f"{names}\nsame colour: corresponding links", transform=left.transAxes, ha="center", va="top")
    fractions = env.metric.link_fractions(expert.embodiment, learner.embodiment)
    right.imshow(fractions, cmap="Blues", vmin=0, vmax=1)
    for (row, column), fraction in np.ndenumerate(fractions):
        if fraction > 0.005:
            right.text(
                column, row, f"{fraction:.0%}", ha="center", va="center", color="white" if fraction > 0.6 else "black"
            )
    right.set_xticks(range(fractions.shape[1]), learner.embodiment.link_names, rotation=30, ha="right")
    right.set_yticks(range(fractions.shape[0]), expert.embodiment.link_names)
    right.set(xlabel="learner", ylabel="expert", title="which expert links a learner link is compared with")
