"""Links of a live follower that are near each other, and how its joints change their distances."""

import logging
from typing import NamedTuple

import mujoco
import numpy as np
from jaxtyping import Bool, Float

from mimic.arms.capsules import Capsules
from mimic.arms.embodiment import Embodiment
from mimic.control.clearance import capsule_axes, pair_distances
from mimic.metric.capsule_distances import clearance_constants, colliding_pairs
from mimic.retargeting.live_pose import LEVI_CIVITA, is_ancestor, joint_spec

APART = 0.015  # chain lengths that links are kept apart, or as in the home pose, where that is less
_NEAR = 0.05  # chain lengths beyond which links do not count
_SPHERE = 1e-6  # m, axis of a capsule that is a sphere
_ALWAYS, _POSES = 0.5, 1000  # fraction of random poses in which links of a pair touch by their shapes' capsules alone
_log = logging.getLogger(__name__)


class Near(NamedTuple):
    """Links that are near each other in a pose.

    Attributes:
      room: [contacts] distances above what links are kept apart [m]; negative where they are nearer.
      gradient: [contacts, joints] of the distances [m/rad].
      geoms: numbers of the nearest two.
    """

    room: Float[np.ndarray, " contacts"]
    gradient: Float[np.ndarray, "contacts joints"]
    geoms: tuple[int, int]


class SelfContacts:
    """Distances of an arm's links by C MuJoCo, from capsules around them.

    Pairs that touch in most of the poses, as those of a short wrist, are not checked: a line of the log names them.

    Args:
      arm: the embodiment.
      capsules: from `fit_capsules`, of the same arm.

    Attributes:
      pairs: of capsules that are checked.
    """

    def __init__(self, arm: Embodiment, capsules: Capsules):
        self._joints = arm.num_joints
        self._names = capsules.links(arm)
        pairs = colliding_pairs(arm, capsules)
        self._minimum = APART * float(arm.chain_length)
        constants = clearance_constants(arm, capsules, pairs=pairs)
        lower, upper = np.clip(np.asarray(arm.joint_range).T, -np.pi, np.pi)
        poses = np.random.default_rng(0).uniform(lower, upper, (_POSES, arm.num_joints))
        poses = np.concatenate([np.asarray(arm.home, float)[None], poses])
        distances = pair_distances(*capsule_axes(poses, constants), constants)
        is_always = np.mean(distances < self._minimum, axis=0) > _ALWAYS
        ignored = sorted({" and ".join(self._names[i] for i in pairs[pair]) for pair in np.flatnonzero(is_always)})
        if ignored:
            _log.warning("links that touch in most poses, which are not kept apart: %s", "; ".join(ignored))
        self.pairs = [pairs[pair] for pair in np.flatnonzero(~is_always)]
        self._model = _model(arm, capsules, self.pairs)
        self._data = data = mujoco.MjData(self._model)
        joints = np.array([self._model.joint(str(joint)).id for joint in range(self._joints)])
        geoms = [self._model.geom(str(number)).id for number in range(len(capsules.joint))]
        self._address, self._columns = self._model.jnt_qposadr[joints], joints
        # By the numbers of geoms: how far apart they are kept, and whether a joint moves the second or the first
        self._apart, self._moves = np.zeros((len(geoms), len(geoms))), np.zeros((len(geoms), len(geoms), self._joints))
        moves = np.array(
            [[is_ancestor(arm, joint, other) for joint in range(self._joints)] for other in capsules.joint]
        )
        self._moves[np.ix_(geoms, geoms)] = moves[None].astype(float) - moves[:, None]
        for (one, other), distance in zip(pairs, distances[0], strict=True):
            places = [geoms[one], geoms[other]], [geoms[other], geoms[one]]
            self._apart[places] = min(self._minimum, distance)
        self._names = [self._names[number] for number in np.argsort(geoms)]
        self._anchors, self._axes = data.xanchor, data.xaxis

    def near(self, qpos: Float[np.ndarray, " joints"]) -> Near | None:
        """Links that are near each other at joint angles [rad]; None where there are none."""
        data = self._data
        data.qpos[self._address] = qpos
        mujoco.mj_kinematics(self._model, data)
        mujoco.mj_collision(self._model, data)
        if not data.ncon:
            return None
        one, other = data.contact.geom.T
        room = data.contact.dist - self._apart[one, other]
        # A normal is from the first geom to the second one; n . (a x r) is r . (n x a).
        cross = self._axes[self._columns] @ (data.contact.frame[:, :3] @ LEVI_CIVITA).reshape(-1, 3, 3)
        levers = data.contact.pos[:, None] - self._anchors[self._columns]
        gradient = np.vecdot(levers, cross) * self._moves[one, other]
        nearest = room.argmin()
        return Near(room, gradient, (int(one[nearest]), int(other[nearest])))

    def names(self, near: Near) -> str:
        """The two links of the nearest contact."""
        return " and ".join(self._names[geom] for geom in near.geoms)

    def touch(self, lanes: Float[np.ndarray, "lanes joints"]) -> Bool[np.ndarray, " lanes"]:
        """Whether links touch, or nearly do, in each pose."""
        found = [self.near(qpos) for qpos in lanes]
        return np.array([near is not None and near.room.min() < -self._minimum / 2 for near in found])


def _model(arm: Embodiment, capsules: Capsules, pairs: list[tuple[int, int]]) -> mujoco.MjModel:
    spec, bodies = joint_spec(arm, 1.0)
    for number, (joint, radius) in enumerate(zip(capsules.joint, capsules.radius, strict=True)):
        body, origin = bodies[joint + 1]
        start, end = (np.asarray(points[number], float) - origin for points in (capsules.start, capsules.end))
        geom = body.add_geom(name=str(number), size=[radius, 0, 0], contype=0, conaffinity=0)
        if np.linalg.norm(end - start) < _SPHERE:
            geom.type, geom.pos = mujoco.mjtGeom.mjGEOM_SPHERE, start
        else:
            geom.type, geom.fromto = mujoco.mjtGeom.mjGEOM_CAPSULE, [*start, *end]
    for one, other in pairs:
        spec.add_pair(geomname1=str(one), geomname2=str(other), margin=_NEAR * float(arm.chain_length))
    return spec.compile()
