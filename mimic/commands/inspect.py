"""What `python -m mimic.inspect` does: says what an arm's file holds, and what would come of training it."""

import dataclasses
import json
import os
import shlex
from collections.abc import Callable
from pathlib import Path
from typing import Any

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt  # noqa: E402
import numpy as np  # noqa: E402
from rich.console import Console  # noqa: E402
from rich.markup import escape  # noqa: E402
from rich.table import Table  # noqa: E402

from mimic.arms.arm import Arm, ArmConfig, rated_speed, torque_scale
from mimic.arms.rendering import ArmScene  # noqa: E402
from mimic.arms.simulation_model import effective_inertia  # noqa: E402
from mimic.commands.arm_checks import ReachableDistance, assumptions, calmed, joint_ranges, reachable_distance, warnings  # noqa: E402
from mimic.commands.config import InspectConfig  # noqa: E402
from mimic.commands.progress import similarity_table  # noqa: E402
from mimic.envs.config import EnvConfig
from mimic.evaluation.rollout_metrics import pose_similarity  # noqa: E402
from mimic.paper_figures.pose_picture import PosePairs, nearest_poses, readable_poses, save_poses  # noqa: E402

_PICTURE, _POSES, _FINDINGS = "arms.png", "poses.png", "inspection.json"
_SCENE = 800, 640  # pixels


def prepare_inspection(config: InspectConfig) -> Callable[[], None]:
    """What inspects an arm.

    Raises:
      ValueError: an arm that cannot be trained, no OpenGL for the picture, or an `out` that exists.
    """
    out = _new_folder(config.out)
    env = EnvConfig(name="pair", expert=config.expert, learner=config.learner, limits=config.limits)
    expert, learner = env.build_arms()
    joints, links = _joints(learner, config.learner, env), _links(expert, learner, env)
    notes = list(learner.notes)
    assumed, warned = list(assumptions(config.learner, learner)), list(warnings(config.learner, learner))
    calm, why = calmed(config.learner, learner, env)
    warned += [why] if why else []
    command = train_command(dataclasses.replace(config, learner=calm))
    near = reachable_distance(expert, learner, env) if config.bound else None
    alike = near and pose_similarity(
        expert.embodiment, learner.embodiment, near.expert_qpos, {"nearest_poses": near.nearest_qpos}
    )
    pairs = out and near and _pose_pairs(expert, learner, env, near)
    scene = (
        ArmScene([config.expert, config.learner], limits=config.limits, width=_SCENE[0], height=_SCENE[1])
        if out
        else None
    )

    def run() -> None:
        console = Console()
        console.print(_headline(expert, learner), highlight=False, soft_wrap=True)
        console.print(_table(f"joints of {learner.embodiment.name}", joints))
        console.print(_table("links, and the expert's links that they are compared with", links))
        for title, lines in (("set aside", notes), ("assumed", assumed), ("mind", warned)):
            for line in lines:
                console.print(f"{title}: {escape(line)}", highlight=False, soft_wrap=True)
        if near is not None and alike is not None:
            console.print(_distance_line(near.bound, near.hold, expert), highlight=False, soft_wrap=True)
            console.print(similarity_table(alike))
        if out and scene:
            out.mkdir()
            with scene:
                _save_picture(
                    out / _PICTURE, scene.image([expert.embodiment.home, learner.embodiment.home]), expert, learner, env
                )
            if pairs:
                save_poses(out / _POSES, expert, learner, env, pairs)
            findings = {
                "arm": learner.embodiment.name,
                "expert": expert.embodiment.name,
                "joints": joints,
                "links": links,
                "set_aside": notes,
                "assumed": assumed,
                "mind": warned,
                "bound": near and near.bound,
                "hold": near and near.hold,
                "similarity": alike,
                "poses": pairs.as_json() if pairs else None,
                "train": command,
            }
            (out / _FINDINGS).write_text(json.dumps(findings, indent=2) + "\n")
            console.print(f"results: {out}", soft_wrap=True, highlight=False)
        console.print(f"train it: {command}", soft_wrap=True, highlight=False, markup=False)

    return run


def _pose_pairs(expert: Arm, learner: Arm, env: EnvConfig, near: ReachableDistance) -> PosePairs:
    poses = readable_poses(env.expert, expert, near.expert_qpos[:, 0])
    return nearest_poses(expert, learner, env.metric, poses)


def train_command(config: InspectConfig) -> str:
    """The command that trains what was inspected."""
    words = ["python -m mimic.train env=pair"]
    words += [word for role in ("expert", "learner") for word in _arm_words(f"env.{role}", getattr(config, role))]
    if config.limits != "none":
        words.append(f"env.limits={config.limits}")
    return " ".join([*words, "env.physics=fused"])


def _arm_words(key: str, arm: ArmConfig) -> list[str]:
    near = os.path.relpath(arm.model) if arm.is_file else arm.model
    words = [f"{key}={arm.model if near.startswith('..') else near}"]
    words += [
        f"{key}.{name}={value}" for name in ("base", "tip", "armature", "damping") if (value := getattr(arm, name))
    ]
    for name in ("locked", "link_lengths"):
        value = getattr(arm, name)
        if value:
            words.append(f"{key}.{name}={str(value if isinstance(value, dict) else list(value)).replace(' ', '')}")
    return [shlex.quote(word) if "{" in word else word for word in (word.replace("'", "") for word in words)]


def _new_folder(path: str) -> Path | None:
    if not path:
        return None
    folder = Path(path).expanduser()
    if folder.exists() or not folder.parent.is_dir():
        reason = "exists; name a new folder" if folder.exists() else f"there is no folder {str(folder.parent)!r}"
        raise ValueError(f"out: {str(folder)!r}: {reason}")
    return folder


def _joints(arm: Arm, config: ArmConfig, env: EnvConfig) -> list[dict[str, Any]]:
    embodiment = arm.embodiment
    columns = {
        "range": joint_ranges(config, arm).tolist(),
        "rated speed": rated_speed(embodiment).tolist(),
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
    arm, shares = learner.embodiment, env.metric.shares(expert.embodiment, learner.embodiment)
    return [
        {
            "link": name,
            "length": float(arm.link_lengths[index]),
            "moved by": arm.joint_names[arm.link_joint[index]] if arm.link_joint[index] >= 0 else "nothing",
            "compared with": {
                other: float(share)
                for other, share in zip(expert.embodiment.link_names, shares[:, index], strict=True)
                if share > 0
            },
        }
        for index, name in enumerate(arm.link_names)
    ]


_HEADERS = {
    "range": "range\n[rad]", "rated speed": "rated speed\n[rad/s]", "torque limit": "torque limit\n[N m]",
    "torque offered": "torque offered\n[N m]", "inertia": "inertia\n[kg m^2]", "length": "length\n[m]",
    "held at": "held at\n[rad]",
}  # fmt: skip


def _table(title: str, rows: list[dict[str, Any]]) -> Table:
    hidden = {"speed is assumed"} | {key for key in ("held at",) if all(row.get(key) is None for row in rows)}
    keys = [key for key in rows[0] if key not in hidden]
    table = Table(title=title, title_justify="left")
    for key in keys:  # names as they are, whatever the width
        table.add_column(escape(_HEADERS.get(key, key)), no_wrap=key in ("joint", "link", "moved by"))
    for row in rows:
        assumed = {"rated speed"} if row.get("speed is assumed") else set()
        table.add_row(*(escape(_text(row.get(key)) + (" assumed" if key in assumed else "")) for key in keys))
    return table


def _text(value: Any) -> str:
    if value is None:
        return "-"
    if isinstance(value, dict):
        return ", ".join(f"{name} {share:.0%}" for name, share in value.items())
    if isinstance(value, list):
        return " to ".join(f"{x:.2f}" for x in value)
    return f"{value:.3g}" if isinstance(value, float) else str(value)


def _headline(expert: Arm, learner: Arm) -> str:
    arm, other = learner.embodiment, expert.embodiment
    return (
        f"{arm.name}: {arm.num_joints} joints, {arm.num_links} links, {arm.chain_length:.3f} m along them, "
        f"{learner.model.body_mass.sum():.2f} kg that move; expert {other.name}: "
        f"{other.num_joints} joints, {other.num_links} links, {other.chain_length:.3f} m"
    )


def _distance_line(bound: float, hold: float, expert: Arm) -> str:
    return (
        f"on random demonstrations of {expert.embodiment.name}, distance of the best poses: {bound:.3f}, of holding "
        f"the start pose: {hold:.3f}; {1 - bound / hold:.0%} of it can be imitated"
    )


def _save_picture(path: Path, image: np.ndarray, expert: Arm, learner: Arm, env: EnvConfig) -> None:
    """Both arms in their start poses beside how much each link of one counts for each of the other."""
    figure, (left, right) = plt.subplots(1, 2, figsize=(13, 5.6), width_ratios=(1.35, 1), layout="constrained")
    left.imshow(image)
    left.axis("off")
    left.set_title(f"{expert.embodiment.name} (expert), {learner.embodiment.name} (learner)")
    shares = env.metric.shares(expert.embodiment, learner.embodiment)
    right.imshow(shares, cmap="Blues", vmin=0, vmax=1)
    for (row, column), share in np.ndenumerate(shares):
        if share > 0.005:
            right.text(column, row, f"{share:.0%}", ha="center", va="center", color="white" if share > 0.6 else "black")
    right.set_xticks(range(shares.shape[1]), learner.embodiment.link_names, rotation=30, ha="right")
    right.set_yticks(range(shares.shape[0]), expert.embodiment.link_names)
    right.set(xlabel="learner", ylabel="expert", title="which expert links a learner link is compared with")
    figure.savefig(path, dpi=100)
    plt.close(figure)
