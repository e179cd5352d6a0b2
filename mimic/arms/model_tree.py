"""Bodies and joints of a MuJoCo model by id: the tree that they form, and their names."""

import mujoco

# As ints: a MuJoCo enum equals a NumPy integer in one order of the operands and not in the other.
_REVOLUTE, _SLIDE = int(mujoco.mjtJoint.mjJNT_HINGE), int(mujoco.mjtJoint.mjJNT_SLIDE)
_KINDS = {int(kind): kind.name.removeprefix("mjJNT_").lower() for kind in mujoco.mjtJoint.__members__.values()}


def joint_kind(model: mujoco.MjModel, joint: int) -> str:
    """MuJoCo's name of a joint's type: hinge, slide, ball or free."""
    return _KINDS[int(model.jnt_type[joint])]


def joint_ids(model: mujoco.MjModel, body: int) -> range:
    """Joints of a body, in order."""
    return range(model.body_jntadr[body], model.body_jntadr[body] + model.body_jntnum[body])


def is_revolute(model: mujoco.MjModel, joint: int) -> bool:
    """Whether a joint is revolute (MuJoCo: hinge), and not that of a base that also slides along two axes."""
    of_body = joint_ids(model, int(model.jnt_bodyid[joint]))
    slides = sum(int(model.jnt_type[other]) == _SLIDE for other in of_body)
    return int(model.jnt_type[joint]) == _REVOLUTE and slides < 2


def ancestors(model: mujoco.MjModel, body: int) -> list[int]:
    """The body, its parent, … and the world."""
    line = [int(body)]
    while line[-1] != 0:
        line.append(int(model.body_parentid[line[-1]]))
    return line


def body_id(model: mujoco.MjModel, name: str) -> int:
    """Id of the body with a name.

    Raises:
      ValueError: no body has this name.
    """
    body = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_BODY, name)
    if body < 0:
        names = ", ".join(model.body(b).name or f"#{b}" for b in range(1, model.nbody))
        raise ValueError(f"the model has no body {name!r}; valid are {names}")
    return body


def tip_body(model: mujoco.MjModel, tip: str) -> int:
    """Id of the body with a name, or of the body with the site of this name.

    Raises:
      ValueError: no body or site has this name.
    """
    site = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_SITE, tip)
    if site >= 0:
        return int(model.site_bodyid[site])
    try:
        return body_id(model, tip)
    except ValueError as error:
        sites = ", ".join(filter(None, (model.site(s).name for s in range(model.nsite)))) or "none"
        raise ValueError(f"{error}, nor a site of that name; valid are {sites}") from None
