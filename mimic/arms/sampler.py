"""Distributions of arms: the locked variants of one arm, and random serial arms. Drawn within compiled functions."""

import itertools
from collections.abc import Callable, Collection, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from mimic.arms.arrays import (
    MAX_JOINTS,
    MAX_LINKS,
    ArmArrays,
    joint_frames,
    lock_joints,
    placements,
    without_mass_on_axes,
)

Sampler = Callable[[Array], ArmArrays]  # random key -> arm, in single precision

_PARALLEL = 1e-4  # rad: axes at a smaller angle are parallel; single precision
# The random arms. The ranges contain those of the arms of mimic and of robosuite: `tests/arms/test_sampler.py`.
_MIN_JOINTS = 4
_REACH = 0.5, 2.0  # m, sum of the link lengths
_BASE_LINK = 0.7  # probability of a link from the base to the first joint
_TILTED_FIRST_AXIS = 0.15  # probability that the first axis is horizontal
_ALONG_AXIS = 0.45  # probability that a link runs along the axis of its joint, as of a joint that rolls a forearm
_SIDEWAYS = 0.5, 0.12  # probability that a link has a sideways offset, and its deviation relative to a mean link
_NEXT_AXIS = (0.15, 0.4, 0.35, 0.1)  # probabilities: parallel, normal to axis and link, along the link, any direction
_RADIUS = 0.03, 0.07  # m, of the links
_DENSITY = 500.0, 3000.0  # kg/m^3, of the links
_HOUSING = 0.2, 3.0  # kg, mass at the end of a link: the next joint's motor, or a tool
_ARMATURE = 0.05, 0.5  # kg m^2
_DAMPING = 0.3, 5.0  # N m s/rad
_SPEED = 1.5, 3.5  # rad/s
# Factors of the perturbed arms, log-uniform.
_SIZE, _MASS = (0.7, 1.4), (0.5, 2.0)
_DRIVES = (0.5, 2.0), (0.5, 2.0), (0.7, 1.4)  # armature, damping, velocity limit
_LOCKED = 0.3  # probability that a joint is locked
_TORQUE_LIMIT = 1e3  # N m: the limit of the environment is below it


def lock_masks(joints: int, most: int, excluded: Collection[Sequence[int]] = ()) -> Float[np.ndarray, "variants 8"]:
    """1 for each locked joint, for each way to lock 1 to `most` of an arm's joints.

    Args:
      joints: number of the arm's joints.
      most: largest number of locked joints, below `joints`.
      excluded: sets of joints, by number from 1, that are left out.
    """
    left_out = {frozenset(joint - 1 for joint in locked) for locked in excluded}
    sets = [
        locked
        for count in range(1, most + 1)
        for locked in itertools.combinations(range(joints), count)
        if frozenset(locked) not in left_out
    ]
    return np.array([np.isin(np.arange(MAX_JOINTS), locked) for locked in sets], float).reshape(-1, MAX_JOINTS)


def lock_sampler(arm: ArmArrays, masks: Float[np.ndarray, "variants 8"]) -> Sampler:
    """One arm with a random one of these sets of joints locked at home."""
    base = jax.tree.map(jnp.asarray, arm.astype(np.float32))
    table = jnp.asarray(masks, jnp.float32)
    return lambda key: lock_joints(base, table[jax.random.randint(key, (), 0, len(table))])


def mixed_sampler(samplers: Sequence[Sampler], probabilities: Sequence[float]) -> Sampler:
    """An arm of one of several samplers."""

    def draw(key: Array) -> ArmArrays:
        key_choice, *keys = jax.random.split(key, len(samplers) + 1)
        arms = [sampler(each) for sampler, each in zip(samplers, keys, strict=True)]
        choice = jax.random.choice(key_choice, len(samplers), p=jnp.asarray(probabilities))
        return jax.tree.map(lambda *x: jnp.stack(x)[choice], *arms)

    return draw


def perturbed_sampler(arms: Sequence[ArmArrays]) -> Sampler:
    """One of several arms, with another size, other masses and drives, and some times with a joint locked at home.

    Lengths have a common factor, and masses have one too, so that every body keeps a positive density. Armature,
    damping and velocity limit of each joint have factors of their own. The base is rotated about the vertical.
    """
    table = jax.tree.map(lambda *x: jnp.stack([jnp.asarray(each, jnp.float32) for each in x]), *arms)
    table = table.replace(**{name: getattr(table, name).astype(jnp.int32) for name in ("link_joint", "hand_joint")})

    def draw(key: Array) -> ArmArrays:
        key_arm, key_size, key_drives, key_lock = jax.random.split(key, 4)
        arm = jax.tree.map(lambda x: x[jax.random.randint(key_arm, (), 0, len(arms))], table)
        of_arm = jax.random.uniform(key_size, (3,))
        length, mass = (_log_uniform(bounds, x) for bounds, x in zip((_SIZE, _MASS), of_arm[:2], strict=True))
        of_joints = jax.random.uniform(key_drives, (3, MAX_JOINTS))
        armature, damping, speed = (_log_uniform(bounds, x) for bounds, x in zip(_DRIVES, of_joints, strict=True))
        rotation = _rotation_about_z(2 * jnp.pi * of_arm[2])
        number_lock, number_joint = jax.random.uniform(key_lock, (2,))
        locked = jnp.floor(number_joint * arm.is_free.sum()) == jnp.cumsum(arm.is_free) - 1
        base_links = (arm.link_joint < 0)[:, None]  # those are given in the base frame

        def rotated(vectors: Array) -> Array:
            return jnp.where(base_links, jnp.sum(rotation * vectors[:, None], axis=-1), vectors)

        perturbed = arm.replace(
            base_rotation=jnp.sum(rotation[:, :, None] * arm.base_rotation[None], axis=1),
            base_position=length * jnp.sum(rotation * arm.base_position, axis=-1),
            offset=length * arm.offset,
            first_moment=mass * length * arm.first_moment,
            second_moment=mass * length**2 * arm.second_moment,
            armature=jnp.where(arm.is_free > 0, armature * arm.armature, arm.armature),
            damping=damping * arm.damping,
            velocity_limit=speed * arm.velocity_limit,
            link_position=length * rotated(arm.link_position),
            link_direction=rotated(arm.link_direction),
            link_length=length * arm.link_length,
            hand_position=length * arm.hand_position,
        )
        return lock_joints(perturbed, arm.is_free * locked * (number_lock < _LOCKED))

    return draw


def _log_uniform(bounds: tuple[float, float], number: Array) -> Array:
    return jnp.exp(np.log(bounds[0]) + np.log(bounds[1] / bounds[0]) * number)


# Above 40 lines because each line is one fact of the distribution. Matrix products are not rounded to TF32.
@jax.default_matmul_precision("highest")
def random_arm(key: Array) -> ArmArrays:
    """A random serial arm of 4 to 8 joints with one link for each, and often one from the base.

    A link runs along its joint's axis or normal to it, sometimes with a sideways offset. The next axis is parallel to
    this one, normal to this one and to the link, along the link, or random. Link lengths are shares of the reach,
    uniform on the simplex and at least a fifth of their mean. A link is a rod of constant density with a sphere at its
    end, so that every body has a positive density. Armature and damping are log-uniform; torques are limited by the
    environment alone. The home pose is 0, and all joint ranges are [-pi, pi].
    """
    key_numbers, key_lengths, key_shape = jax.random.split(key, 3)
    key_hand = jax.random.fold_in(key, 3)
    numbers = jax.random.uniform(key_numbers, (5, MAX_JOINTS))  # one call compiles faster than many

    def uniform(bounds: tuple[float, float], number: Array) -> Array:
        return bounds[0] + (bounds[1] - bounds[0]) * number

    of_arm = numbers[0]
    count = _MIN_JOINTS + jnp.floor((MAX_JOINTS + 1 - _MIN_JOINTS) * of_arm[0])
    slots = jnp.arange(MAX_JOINTS)
    exists = (slots < count).astype(jnp.float32)
    has_base = (of_arm[1] < _BASE_LINK).astype(jnp.float32)
    present = jnp.concatenate([has_base[None], exists])
    shares = present * (0.2 + 0.8 * jax.random.exponential(key_lengths, (MAX_JOINTS + 1,)))
    lengths = uniform(_REACH, of_arm[2]) * shares / shares.sum()
    axes, steps = _shape(key_shape, lengths[1:], exists)
    rotation = _rotation_about_z(2 * jnp.pi * of_arm[3])
    lengths = lengths * present
    base_step = lengths[0] * jnp.array([0.0, 0.0, 1.0])
    anchors = base_step + jnp.concatenate([jnp.zeros((1, 3)), jnp.cumsum(steps, axis=0)[:-1]])
    axes, steps, anchors = (jnp.sum(rotation * x[:, None], axis=-1) for x in (axes, steps, anchors))
    radius, density = uniform(_RADIUS, of_arm[4]), uniform(_DENSITY, of_arm[5])
    housings = jnp.sort(uniform(_HOUSING, numbers[1]))[::-1]  # motors are smaller towards the tip
    armature, damping, speed = (
        _log_uniform(_ARMATURE, numbers[2]),
        _log_uniform(_DAMPING, numbers[3]),
        uniform(_SPEED, numbers[4]),
    )
    masses = jax.vmap(_rod_with_sphere, (0, None, None, 0))(steps, radius, density, housings)
    rotations, origins = joint_frames(axes, anchors, _PARALLEL)
    twist, offset, reference, _ = placements(rotations, origins)
    moments = without_mass_on_axes(
        _in_frames(exists[:, None, None] * masses, rotations, origins, anchors), rotations, origins
    )
    middles = jnp.concatenate([0.5 * base_step[None], anchors + 0.5 * steps])
    axes_of_link = jnp.concatenate([jnp.eye(3)[None], rotations])
    origin_of_link = jnp.concatenate([jnp.zeros((1, 3)), origins])
    directions = jnp.concatenate([base_step[None], steps]) / jnp.maximum(lengths, 1e-6)[:, None]
    links = MAX_LINKS - MAX_JOINTS - 1
    own = exists[:, None]
    return ArmArrays(
        base_rotation=rotations[0],
        base_position=origins[0],
        twist=jnp.where(own > 0, twist, jnp.array([1.0, 0.0])),
        offset=own * offset,
        reference=exists * reference,
        first_moment=own * moments[:, :2, 3],
        second_moment=own * moments[:, (0, 1, 0, 0, 1), (0, 1, 1, 2, 2)],
        armature=jnp.where(exists > 0, armature, 1.0),
        damping=exists * damping,
        is_free=exists,
        home=jnp.zeros(MAX_JOINTS),
        joint_range=jnp.tile(jnp.array([-jnp.pi, jnp.pi]), (MAX_JOINTS, 1)),
        velocity_limit=speed,
        torque_limit=jnp.full(MAX_JOINTS, _TORQUE_LIMIT),
        link_joint=jnp.concatenate([jnp.where(present > 0, jnp.arange(-1, MAX_JOINTS), -1), jnp.full(links, -1)]),
        link_position=_links(present[:, None] * _into(axes_of_link, middles - origin_of_link), links),
        link_direction=_links(_into(axes_of_link, directions), links).at[:, 0].add(1 - _links(present, links)),
        link_length=_links(lengths, links),
        **_random_hand(anchors + steps, directions[1:], rotations, origins, count, key_hand),
    )


def _random_hand(
    ends: Array, directions: Array, rotations: Array, origins: Array, count: Array, key: Array
) -> dict[str, Any]:
    """The fields of the hand of `ArmArrays`: at the end of the last link, along it, rotated about it by any angle."""
    last = count.astype(jnp.int32) - 1
    approach, angle = directions[last], jax.random.uniform(key, (), minval=-jnp.pi, maxval=jnp.pi)
    across = _unit(_without(jnp.eye(3)[jnp.argmin(jnp.abs(approach))], approach))
    x = jnp.cos(angle) * across + jnp.sin(angle) * jnp.cross(approach, across)
    frame = jnp.stack([x, jnp.cross(approach, x), approach], axis=1)
    to_joint = rotations[last].T
    return {
        "hand_joint": last,
        "hand_position": to_joint @ (ends[last] - origins[last]),
        "hand_rotation": to_joint @ frame,
    }


def _links(values: Array, empty: int) -> Array:
    """Values of links, with empty slots after them."""
    return jnp.concatenate([values, jnp.zeros((empty, *values.shape[1:]))])


def _into(rotations: Float[Array, "n 3 3"], vectors: Float[Array, "n 3"]) -> Float[Array, "n 3"]:
    """R^T v of each."""
    return jnp.sum(rotations * vectors[:, :, None], axis=1)


def _shape(
    key: Array, lengths: Float[Array, " joints"], exists: Float[Array, " joints"]
) -> tuple[Float[Array, "joints 3"], Float[Array, "joints 3"]]:
    """Axes of the joints, and steps from each anchor to the next [m], in the zero pose."""
    key_uniform, key_normal = jax.random.split(key)
    uniform = jax.random.uniform(key_uniform, (MAX_JOINTS, 4))
    normals = jax.random.normal(key_normal, (MAX_JOINTS, 7))
    is_tilted = uniform[0, 3] < _TILTED_FIRST_AXIS
    first = jnp.where(is_tilted, jnp.array([0.0, 1.0, 0.0]), jnp.array([0.0, 0.0, 1.0]))

    def next_joint(axis: Array, joint: tuple[Array, Array]) -> tuple[Array, tuple[Array, Array]]:
        (along, has_offset, next_axis, _), normal_numbers = joint
        is_along = along < _ALONG_AXIS
        normal, any_axis = _unit(_without(normal_numbers[:3], axis)), _unit(normal_numbers[3:6])
        sideways = _SIDEWAYS[1] * normal_numbers[6] * (has_offset < _SIDEWAYS[0])
        direction = _unit(jnp.where(is_along, axis + sideways * normal, normal + sideways * axis))
        third = _unit(_without(jnp.cross(axis, direction), axis) + 1e-3 * jnp.cross(axis, normal))
        options = jnp.stack([axis, third, jnp.where(is_along, normal, direction), any_axis])
        choice = jnp.sum(next_axis > jnp.cumsum(jnp.array(_NEXT_AXIS))[:-1])
        return options[choice], (axis, direction)

    _, (axes, directions) = jax.lax.scan(next_joint, first, (uniform, normals))
    return axes, (exists * lengths)[:, None] * directions


def _without(vector: Array, axis: Array) -> Array:
    return vector - jnp.sum(vector * axis) * axis


def _unit(vector: Array) -> Array:
    return vector / jnp.maximum(jnp.sqrt(jnp.sum(vector * vector)), 1e-9)


def _rod_with_sphere(step: Array, radius: Array, density: Array, housing: Array) -> Float[Array, "4 4"]:
    """Moments of mass about the start of a rod with a sphere at its end, see `pseudo_inertia`."""
    length = jnp.sqrt(jnp.sum(step * step))
    rod = density * jnp.pi * radius**2 * length
    outer = step[:, None] * step
    across = jnp.eye(3) - outer / jnp.maximum(length**2, 1e-12)
    second = rod * (outer / 3 + 0.25 * radius**2 * across) + housing * (outer + 0.2 * radius**2 * jnp.eye(3))
    first = (0.5 * rod + housing) * step
    upper = jnp.concatenate([second, first[:, None]], axis=1)
    return jnp.concatenate([upper, jnp.append(first, rod + housing)[None]])


def _in_frames(
    masses: Float[Array, "joints 4 4"],
    rotations: Float[Array, "joints 3 3"],
    origins: Float[Array, "joints 3"],
    anchors: Float[Array, "joints 3"],
) -> Float[Array, "joints 4 4"]:
    """Moments about anchors, in base axes, as moments in the frames of the joints."""

    def in_frame(mass: Array, rotation: Array, origin: Array, anchor: Array) -> Array:
        upper = jnp.concatenate([rotation.T, (rotation.T @ (anchor - origin))[:, None]], axis=1)
        transform = jnp.concatenate([upper, jnp.array([[0.0, 0.0, 0.0, 1.0]])])
        return transform @ mass @ transform.T

    return jax.vmap(in_frame)(masses, rotations, origins, anchors)


def _rotation_about_z(angle: Array) -> Float[Array, "3 3"]:
    cosine, sine = jnp.cos(angle), jnp.sin(angle)
    return jnp.array([[cosine, -sine, 0.0], [sine, cosine, 0.0], [0.0, 0.0, 1.0]])
