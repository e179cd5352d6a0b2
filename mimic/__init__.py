"""mimic: a metric between robot arms of different kinematics, and imitation learning with it, in JAX and MJX.

The core functions are pure and take one sample; batch them with `jax.vmap`.
"""

import importlib
import sys
from typing import TYPE_CHECKING, Any

from mimic.runs import signals

if signals.runs_as_command():  # a command ends in one line from here on: the imports below take a second
    signals.watch_signals()

from mimic.base import compat  # noqa: E402
from mimic.base.distribution import VERSION  # noqa: E402

compat.prepare_cpu()  # before JAX starts its backend: see mimic.base.compat

if TYPE_CHECKING:
    from mimic.arms.arm import ArmConfig, build_arm
    from mimic.arms.capsules import Capsules, fit_capsules
    from mimic.arms.embodiment import Embodiment, load_mjcf, panda, planar_arm
    from mimic.arms.rendering import ArmScene
    from mimic.base.registry import register
    from mimic.commands.fit import Run, fit
    from mimic.envs import env_config, environments
    from mimic.envs.imitation import ImitationEnv
    from mimic.envs.make import make
    from mimic.metric.correspondence import (
        arc_length_correspondence,
        hard_correspondence,
        overlap_correspondence,
        soft_correspondence,
    )
    from mimic.metric.distance import (
        PAPER_WEIGHTS,
        DistanceWeights,
        LinkDistance,
        PairDistances,
        adaptive_weights,
        embodiment_distance,
        link_distances,
        rotation_distance,
    )
    from mimic.metric.kinematics import (
        Frames,
        LinkStates,
        body_twists,
        candidate_points,
        forward_kinematics,
        link_states,
    )
    from mimic.metric.landscape import distance_landscape, local_minima
    from mimic.metric.motion_distance import motion_distance
    from mimic.motions.demonstrations import Demonstrations, check_effort, load_demonstrations
    from mimic.motions.importing import import_demonstrations
    from mimic.motions.recording import record_demonstrations
    from mimic.retargeting.costs import Costs
    from mimic.retargeting.kinematic_bound import ClosestMotion, closest_motion, kinematic_bound
    from mimic.retargeting.pose import PoseImitation, imitate_pose
    from mimic.retargeting.trajectory import imitate_trajectory
    from mimic.trainers.export.export import export_run
    from mimic.trainers.pose_mapper.any_arm_mapper import AnyArmMapper
    from mimic.trainers.pose_mapper.model import PoseMapper
    from mimic.trainers.pretrained.network import Pretrained, load

__version__ = VERSION

__all__ = [
    "PAPER_WEIGHTS",
    "AnyArmMapper",
    "ArmConfig",
    "ArmScene",
    "Capsules",
    "ClosestMotion",
    "Costs",
    "Demonstrations",
    "DistanceWeights",
    "Embodiment",
    "Frames",
    "ImitationEnv",
    "LinkDistance",
    "LinkStates",
    "PairDistances",
    "PoseImitation",
    "PoseMapper",
    "Pretrained",
    "Run",
    "adaptive_weights",
    "arc_length_correspondence",
    "body_twists",
    "build_arm",
    "candidate_points",
    "check_effort",
    "closest_motion",
    "distance_landscape",
    "embodiment_distance",
    "env_config",
    "environments",
    "export_run",
    "fit",
    "fit_capsules",
    "forward_kinematics",
    "hard_correspondence",
    "imitate_pose",
    "imitate_trajectory",
    "import_demonstrations",
    "kinematic_bound",
    "link_distances",
    "link_states",
    "load",
    "load_demonstrations",
    "load_mjcf",
    "local_minima",
    "make",
    "motion_distance",
    "overlap_correspondence",
    "panda",
    "planar_arm",
    "record_demonstrations",
    "register",
    "rotation_distance",
    "soft_correspondence",
]


# Modules of the public names. They are imported at the first access: JAX, MuJoCo and brax take seconds, and
# `mimic.deploy` needs none of them.
_MODULES = {
    "arms.arm": ("ArmConfig", "build_arm"),
    "arms.capsules": ("Capsules", "fit_capsules"),
    "arms.embodiment": ("Embodiment", "load_mjcf", "panda", "planar_arm"),
    "arms.rendering": ("ArmScene",),
    "trainers.export.export": ("export_run",),
    "commands.fit": ("Run", "fit"),
    "envs": ("env_config", "environments"),
    "motions.demonstrations": ("Demonstrations", "check_effort", "load_demonstrations"),
    "envs.imitation": ("ImitationEnv",),
    "motions.importing": ("import_demonstrations",),
    "motions.recording": ("record_demonstrations",),
    "envs.make": ("make",),
    "metric.correspondence": (
        "arc_length_correspondence",
        "hard_correspondence",
        "overlap_correspondence",
        "soft_correspondence",
    ),
    "metric.distance": (
        "PAPER_WEIGHTS",
        "DistanceWeights",
        "LinkDistance",
        "PairDistances",
        "adaptive_weights",
        "embodiment_distance",
        "link_distances",
        "rotation_distance",
    ),
    "metric.kinematics": (
        "Frames",
        "LinkStates",
        "body_twists",
        "candidate_points",
        "forward_kinematics",
        "link_states",
    ),
    "metric.landscape": ("distance_landscape", "local_minima"),
    "metric.motion_distance": ("motion_distance",),
    "trainers.pretrained.network": ("Pretrained", "load"),
    "base.registry": ("register",),
    "retargeting.costs": ("Costs",),
    "retargeting.kinematic_bound": ("ClosestMotion", "closest_motion", "kinematic_bound"),
    "retargeting.pose": ("PoseImitation", "imitate_pose"),
    "retargeting.trajectory": ("imitate_trajectory",),
    "trainers.pose_mapper.any_arm_mapper": ("AnyArmMapper",),
    "trainers.pose_mapper.model": ("PoseMapper",),
}
_MODULE_OF = {name: module for module, names in _MODULES.items() for name in names}
_WITH_MJX = ("ImitationEnv", "Run", "export_run", "fit")  # MJX is imported first, see `compat.import_mjx`
_WITHOUT_MJX = [
    name for name in _MODULES if not {"rendering", "imitation", "commands", "trainers"} & {*name.split(".")}
]
_FOLDERS = ("arms", "envs", "metric", "retargeting")  # attributes after `import mimic` alone


def __getattr__(name: str) -> Any:
    if name in _FOLDERS:
        for module in (name, *(module for module in _WITHOUT_MJX if module.startswith(f"{name}."))):
            importlib.import_module(f"mimic.{module}")
        return sys.modules[f"mimic.{name}"]
    if name not in _MODULE_OF:
        raise AttributeError(f"module 'mimic' has no attribute {name!r}")
    if name in _WITH_MJX:
        compat.import_mjx()
    value = getattr(importlib.import_module(f"mimic.{_MODULE_OF[name]}"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return [*__all__, "__doc__", "__version__"]
