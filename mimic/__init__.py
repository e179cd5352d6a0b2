"""mimic: a metric between robot arms of different kinematics, and imitation learning with it, in JAX and MJX.

The core functions are pure and take one sample; batch them with `jax.vmap`.
"""

from typing import TYPE_CHECKING, Any

from mimic.runs import signals

if signals.runs_as_command():  # a command ends in one line from here on: the imports below take a second
    signals.watch_signals()

from mimic import compat  # noqa: E402

compat.prepare_cpu()  # before JAX starts its backend: see mimic.compat
compat.import_mujoco()

from mimic.arms.arm import ArmConfig, build_arm  # noqa: E402
from mimic.arms.capsules import Capsules, fit_capsules  # noqa: E402
from mimic.arms.embodiment import Embodiment, load_mjcf, panda, planar_arm  # noqa: E402
from mimic.distribution import VERSION  # noqa: E402
from mimic.envs import env_config, environments  # noqa: E402
from mimic.envs.demonstrations import Demonstrations, check_effort, load_demonstrations  # noqa: E402
from mimic.envs.importing import import_demonstrations  # noqa: E402
from mimic.envs.recording import record_demonstrations  # noqa: E402
from mimic.making import make  # noqa: E402
from mimic.metric.correspondence import (  # noqa: E402
    arc_length_correspondence,
    hard_correspondence,
    overlap_correspondence,
    soft_correspondence,
)
from mimic.metric.distance import (  # noqa: E402
    PAPER_WEIGHTS,
    DistanceWeights,
    LinkDistance,
    PairDistances,
    adaptive_weights,
    embodiment_distance,
    link_distances,
    rotation_distance,
)
from mimic.metric.kinematics import (  # noqa: E402
    Frames,
    LinkStates,
    body_twists,
    candidate_points,
    forward_kinematics,
    link_states,
)
from mimic.metric.landscape import distance_landscape, local_minima  # noqa: E402
from mimic.metric.motion_distance import motion_distance  # noqa: E402
from mimic.registry import register  # noqa: E402
from mimic.retargeting.costs import Costs  # noqa: E402
from mimic.retargeting.kinematic_bound import ClosestMotion, closest_motion, kinematic_bound  # noqa: E402
from mimic.retargeting.pose import PoseImitation, imitate_pose  # noqa: E402
from mimic.retargeting.trajectory import imitate_trajectory  # noqa: E402

if TYPE_CHECKING:
    from mimic.arms.rendering import ArmScene
    from mimic.commands.export import export_run
    from mimic.commands.fit import Run, fit
    from mimic.envs.imitation import ImitationEnv
    from mimic.pretrained.network import Pretrained, load
    from mimic.trainers.pose_mapper.any_arm_mapper import AnyArmMapper
    from mimic.trainers.pose_mapper.model import PoseMapper

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


def __getattr__(name: str) -> Any:
    if name == "ImitationEnv":  # imports brax and MJX, which takes seconds
        compat.import_mjx()
        from mimic.envs.imitation import ImitationEnv

        return ImitationEnv
    if name == "ArmScene":  # imports the renderer, which few need
        from mimic.arms.rendering import ArmScene

        return ArmScene
    if name == "PoseMapper":  # imports flax networks and checkpoints
        from mimic.trainers.pose_mapper.model import PoseMapper

        return PoseMapper
    if name == "AnyArmMapper":
        from mimic.trainers.pose_mapper.any_arm_mapper import AnyArmMapper

        return AnyArmMapper
    if name in ("Pretrained", "load"):  # imports the trainers' configs
        from mimic.pretrained import network

        return getattr(network, name)
    if name == "export_run":  # imports all of these
        compat.import_mjx()
        from mimic.commands.export import export_run

        return export_run
    if name in ("Run", "fit"):  # imports training
        compat.import_mjx()
        from mimic.commands import fit

        return getattr(fit, name)
    raise AttributeError(f"module 'mimic' has no attribute {name!r}")


def __dir__() -> list[str]:
    return [*__all__, "__doc__", "__version__"]
