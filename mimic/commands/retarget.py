"""`python -m mimic.retarget`: a data set or demonstrations of one arm as those of another."""

import dataclasses
import itertools
import os
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from mimic.arms.arm import ArmConfig, build_arm
from mimic.arms.capsules import Capsules, fit_capsules
from mimic.arms.embodiment import Embodiment
from mimic.arms.gripper import GripperRange, gripper_range
from mimic.base import compat
from mimic.base.compilation import use_compilation_cache
from mimic.base.config import new_path
from mimic.commands.certificate_plot import plot_certificates
from mimic.commands.config import RetargetConfig, base_numbers
from mimic.commands.printed import say
from mimic.commands.retargeted_motions import MOTIONS, save_motions
from mimic.metric.config import MetricConfig
from mimic.motions.formats.episodes import Motion
from mimic.motions.grippers import other_gripper
from mimic.motions.rewriting import DataSet, read_data_set, write_data_set
from mimic.retargeting.base_placement import find_base
from mimic.retargeting.certificate import Certificate, certify
from mimic.retargeting.motions import largest_jump, retarget_motions
from mimic.retargeting.self_collision import make_contacts
from mimic.runs.files import REPORT, write_report, written_atomically

_PICTURE = "certificate.png"
_WARNING = "warning"  # how notes begin that are printed before the work
_ATTEMPTS, _FEW = 4, 0.2  # for each episode; fraction of its frames that fail
_THREADS = 8  # at most; each certifies an episode
_AT_ONCE = {"cpu": 2**12, "gpu": 2**16}  # frames of a group of episodes; a longer episode is a group of its own
_SHOWN = 12  # episodes in the table; those that fail come first


class _Setting(NamedTuple):
    """What all episodes of a data set share; `openings` are the learner's, by entry and episode."""

    expert: Embodiment
    learner: Embodiment
    metric: MetricConfig
    hand: str
    base: list[float] | None
    dt: float
    seed: int
    grippers: tuple[GripperRange | None, GripperRange | None]
    openings: Mapping[str, Mapping[str, np.ndarray | None]]
    costs: Any
    capsules: Capsules | None
    contacts: Callable[..., Any] | None


def prepare_retargeting(config: RetargetConfig) -> Callable[[], int]:
    """Checks the config and reads the data set; the returned function retargets, certifies and writes it.

    Raises:
      ValueError: a key without effect, costs of motion with exact hands, a source that cannot be read or is named as
        another file in `out`, arms without the hands that `hand` needs, or `out` exists.
    """
    use_compilation_cache(config.compilation_cache)
    if not config.source:
        raise ValueError("source: expected a data set or a file of demonstrations, as in source=FOLDER")
    source = Path(config.source).expanduser()
    if source.name in (MOTIONS, _PICTURE, REPORT):
        raise ValueError(f"source: expected another name than {source.name}, which is of a file beside the data set")
    if config.hand != "scaled" and config.costs.of_motion:
        raise ValueError("costs: expected no velocity or acceleration with an exact or near hand; hand=scaled has them")
    if config.hand == "scaled" and config.base == "auto":
        raise ValueError("base: expected no auto with hand=scaled, which compares each arm from its own base")
    out, env = new_path("out", config.out), config.resolve()
    expert, learner = env.build_arms().embodiments
    free = build_arm(dataclasses.replace(env.expert, home=None), config.limits or "none").embodiment
    for arm in (expert, learner) if config.hand != "scaled" else ():
        if not len(arm.hand_joint):
            raise ValueError(
                f"expected arms whose hand is known, got {arm.name}; env.ROLE.hand= names its frame, and hand=scaled "
                "needs none"
            )
    data = read_data_set(
        source, free, joints=config.joints, topic=config.topic, units=config.units, rate=config.rate,
        joint_range=expert.joint_range,
    )  # fmt: skip
    dt = float(np.median(np.concatenate([np.diff(motion.time) for motion in data.measured.values()])))
    shapes = _shapes(env.learner, env.limits)
    config.costs.check_capsules(shapes[0])
    grippers = (gripper_range(env.expert), gripper_range(env.learner)) if data.grippers else (None, None)
    setting = _Setting(
        expert, learner, env.metric, config.hand, base_numbers(config.base), dt, config.seed, grippers,
        mapped_grippers(data, grippers), config.costs, *shapes,
    )  # fmt: skip

    def run() -> int:
        console = Console()
        say(console, *(note for note in data.notes if note.startswith(_WARNING)))
        used = _with_base(setting, config.base, data, console)
        motions: dict[str, dict[str, Motion]] = {entry: {} for entry in data.motions}
        certificates = {}
        with console.status(f"retargeting {len(data.measured)} episodes to {learner.name}") as status:
            for number, (name, (found, certificate)) in enumerate(_retargeted(data, used), start=1):
                status.update(f"retargeting to {learner.name}: {number} of {len(data.measured)} episodes")
                certificates[name] = certificate
                for entry, motion in found.items():
                    motions[entry][name] = motion
        kept = [name for name, item in certificates.items() if item.is_ok or config.failing == "kept"]
        if not kept:
            _print(console, data, certificates, kept, used, ())
            print("error: no episode to write; failing=kept writes those that fail too", file=sys.stderr)
            return 1
        with written_atomically(out) as folder:
            ranges, yaw = np.asarray(learner.joint_range, float), used.base[3] if used.base else 0.0
            lines = write_data_set(data, folder, learner, motions, kept, ranges, yaw)
            report = _report(data, certificates, kept, used, config)
            write_report(folder, report)
            base = None if config.hand == "scaled" else used.base or [0.0] * 4
            save_motions(folder, (expert, learner), data.measured, motions[data.entry], base)
            plot_certificates(certificates, dt, folder / _PICTURE, f"{expert.name} to {learner.name}, {data.path.name}")
        _print(console, data, certificates, kept, used, lines)
        say(console, f"results: {out}")
        return 0

    return run


def _retargeted(data: DataSet, setting: _Setting) -> Iterator[tuple[str, tuple[dict[str, Motion], Certificate]]]:
    """Each episode's name, motions and certificate, by groups of episodes."""
    names, at_once = list(data.measured), _AT_ONCE["cpu" if compat.is_cpu() else "gpu"]
    ends = np.cumsum([len(data.measured[name].time) for name in names])
    for _, group in itertools.groupby(zip(names, ends, strict=True), key=lambda item: (item[1] - 1) // at_once):
        yield from retarget_episodes(data, [name for name, _ in group], setting).items()


def retarget_episodes(
    data: DataSet, names: Sequence[str], setting: _Setting
) -> dict[str, tuple[dict[str, Motion], Certificate]]:
    """The learner's motions of episodes by entry, and the certificates of the measured ones.

    Episodes of which few frames fail are searched again from other random poses; the motion with the fewest counts.
    Commands are retargeted with the measured motion, as one path there and back, so that both have one posture and
    the lag between them stays.
    """
    best = dict(zip(names, _retarget_from(data, names, setting), strict=True))
    again = list(names)
    for attempt in range(1, _ATTEMPTS):
        again = [name for name in again if 0 < np.mean(np.array(best[name][1].causes) != "") < _FEW]
        if not again:
            break
        others = _retarget_from(data, again, setting._replace(seed=setting.seed + attempt))
        for name, other in zip(again, others, strict=True):
            if sum(map(bool, other[1].causes)) < sum(map(bool, best[name][1].causes)):
                best[name] = other
    return best


def _retarget_from(
    data: DataSet, names: Sequence[str], setting: _Setting
) -> Iterator[tuple[dict[str, Motion], Certificate]]:
    """See `retarget_episodes`; from the random poses of one seed."""
    jump = largest_jump(setting.learner, setting.dt)
    paths = [
        np.concatenate([motions[name].qpos[:: (-1) ** index] for index, motions in enumerate(data.motions.values())])
        for name in names
    ]
    found = retarget_motions(
        setting.expert, setting.learner, paths, setting.metric, hand=setting.hand, base=setting.base,
        largest_jump=jump, seed=setting.seed, costs=setting.costs, capsules=setting.capsules,
    )  # fmt: skip

    def certified(name: str, path: np.ndarray) -> tuple[dict[str, Motion], Certificate]:
        measured, motions = data.measured[name], {}
        count = len(measured.time)
        for index, entry in enumerate(data.motions):
            qpos = path[index * count : (index + 1) * count][:: (-1) ** index]
            qvel = np.gradient(qpos, measured.time, axis=0)
            motions[entry] = Motion(measured.time, qpos, qvel, setting.openings[entry][name])
        certificate = certify(
            setting.expert, setting.learner, measured.qpos, motions[data.entry].qpos, jump,
            base=setting.base, capsules=setting.capsules, contacts=setting.contacts,
            demands_hand=setting.hand == "exact",
        )  # fmt: skip
        return motions, certificate

    with ThreadPoolExecutor(min(os.cpu_count() or 1, _THREADS)) as pool:
        yield from pool.map(certified, names, found)


def mapped_grippers(
    data: DataSet, grippers: tuple[GripperRange | None, GripperRange | None]
) -> dict[str, dict[str, np.ndarray | None]]:
    """The gripper's values by entry and episode, as those of the learner's gripper where its range is another."""
    openings = {}
    for entry, motions in data.motions.items():
        own: list[Any] = [motion.gripper for motion in motions.values()]
        if all(gripper is not None for gripper in own):
            (name, *_) = data.grippers.get(entry, ("", ()))[1] or ("",)
            mapped = other_gripper(np.concatenate(own), *grippers, name)
            if mapped is not None:
                own = np.split(mapped, np.cumsum([len(gripper) for gripper in own])[:-1])
        openings[entry] = dict(zip(motions, own, strict=True))
    return openings


def _shapes(arm: ArmConfig, limits: str) -> tuple[Capsules, Callable[..., Any]] | tuple[None, None]:
    """Capsules around the links of an arm, and what tells contacts; None where it has no shapes."""
    try:
        return fit_capsules(arm, limits), make_contacts(arm, limits)
    except ValueError:
        return None, None


def _with_base(setting: _Setting, base: Any, data: DataSet, console: Console) -> _Setting:
    """The setting with the placement that is found for the data set, with base=auto."""
    if base != "auto":
        return setting
    arguments = setting.metric.build(setting.expert, setting.learner).arguments
    paths = [motion.qpos for motion in data.measured.values()]
    with console.status("placing the base"):
        found = find_base(
            setting.expert, setting.learner, paths, largest_jump=largest_jump(setting.learner, setting.dt), **arguments
        )
    return setting._replace(base=[round(float(number), 4) for number in found])


def _report(
    data: DataSet,
    certificates: Mapping[str, Certificate],
    kept: Sequence[str],
    setting: _Setting,
    config: RetargetConfig,
) -> dict[str, Any]:
    rows = [{"episode": name, "written": name in kept, **item.summary()} for name, item in certificates.items()]
    return {
        "source": str(data.path),
        "expert": setting.expert.name,
        "learner": setting.learner.name,
        "hand": setting.hand,
        "base": setting.base or [0.0, 0.0, 0.0, 0.0],
        "units": data.unit,
        "measured": data.entry,
        "commanded": list(data.commands),
        "gripper": list(data.gripper),
        "failing": config.failing,
        "episodes": rows,
        "not_retargeted": dict(data.faults),
        "notes": list(data.notes),
    }


def _print(
    console: Console,
    data: DataSet,
    certificates: Mapping[str, Certificate],
    kept: Sequence[str],
    setting: _Setting,
    written: Sequence[str],
) -> None:
    """Prints the certificates, those that fail first, and lines about what was assumed, written and left out."""
    title = f"{data.path.name}: {setting.expert.name} to {setting.learner.name}, hand={setting.hand}"
    table = Table(title=title, title_justify="left")
    for header in ("episode", "exact frames", "hand [mm]", "[deg]", "margin [deg]", "speed", "clearance [mm]"):
        table.add_column(escape(header), justify="left" if header == "episode" else "right")
    names = sorted(certificates, key=lambda name: certificates[name].is_ok)
    for name in names[:_SHOWN]:
        item = certificates[name]
        table.add_row(
            name,
            f"{item.is_exact.sum()} of {len(item.causes)}",
            _number(1e3 * item.position.max(), 2),
            _number(np.degrees(item.rotation.max()), 2),
            _number(np.degrees(item.margin.min()), 1),
            f"{item.speed.max():.0%}",
            _number(1e3 * item.clearance.min(), 0),
        )
    console.print(table)
    lines = [f"episodes: {len(kept)} of {len(certificates) + len(data.faults)} are written"]
    lines += [f"{len(names) - _SHOWN} more episodes in {REPORT}"] if len(names) > _SHOWN else []
    for name in [name for name in names if not certificates[name].is_ok][:_SHOWN]:
        runs = list(certificates[name].failures())
        first, last, cause = max(runs, key=lambda run: run[1] - run[0])
        more = f", and {len(runs) - 1} more times" if len(runs) > 1 else ""
        lines.append(f"{name} fails: {cause}, frames {first} to {last}{more}")
    lines += _overlap_lines(certificates)
    lines += [f"not retargeted: {name}: {fault}" for name, fault in list(data.faults.items())[:_SHOWN]]
    base = setting.base or [0.0, 0.0, 0.0, 0.0]
    lines.append(f"base of {setting.learner.name} in that of {setting.expert.name} [m, rad]: {base}")
    lines += [note for note in data.notes if not note.startswith(_WARNING)]
    lines += [f"commands: {', '.join(data.commands) or 'none'}"]
    lines.append(_gripper_line(data, setting))
    say(console, *lines, *written, *filter(None, [_help_line(certificates, setting)]))


def _overlap_lines(certificates: Mapping[str, Certificate]) -> list[str]:
    """What a negative clearance means, with the links of the smallest one."""
    smallest = {name: float(item.clearance.min()) for name, item in certificates.items() if item.clearance.min() < 0}
    if not smallest:
        return []
    name = min(smallest, key=smallest.__getitem__)
    overlap = f"{certificates[name].nearest} overlap, by {-1e3 * smallest[name]:.0f} mm in {name}"
    return [f"clearance below 0: capsules around {overlap}; whether links touch, their shapes decide"]


def _number(value: float, digits: int) -> str:
    """A cell of the table; what is not known, as of an arm without a hand or without shapes, is a dash."""
    return "-" if np.isnan(value) else f"{round(value, digits) + 0.0:.{digits}f}"  # 0.0 and not -0.0


def _gripper_line(data: DataSet, setting: _Setting) -> str:
    """What became of the gripper."""
    if not data.gripper:
        return "gripper: none"
    name, motion = next(iter(data.measured.items()))
    expert, learner = setting.grippers
    if expert is None or learner is None or setting.openings[data.entry][name] is motion.gripper:
        return f"gripper, as in the source: {', '.join(data.gripper)}"
    ends = (
        f"{', '.join(f'{x:.3g}' for x in end)}"
        for end in (expert.closed, expert.opened, learner.closed, learner.opened)
    )
    return "gripper: closed at {}, open at {} becomes closed at {}, open at {}".format(*ends)


def _help_line(certificates: Mapping[str, Certificate], setting: _Setting) -> str:
    """What would help the episodes that fail; empty where none does."""
    failing = [item for item in certificates.values() if not item.is_ok]
    if not failing:
        return ""
    causes = " ".join(cause for item in failing for cause in item.causes)
    advice = []
    if "velocity limit" in causes:
        advice.append("a slower source (velocity limits)")
    if "out of reach" in causes or "range" in causes:
        advice.append("another base (base=auto)" if setting.base is None else "another base (base=[x,y,z,yaw])")
    if "touch" in causes:
        advice.append("a cost of touching (costs.self_collision=0.1)")
    if "hand" in causes:
        advice.append("hand=near, which takes the nearest hand")
    return f"what would help: {'; '.join(advice)}" if advice else ""
