"""Random motions of two arms, to write as a dataset."""

from typing import Any

import numpy as np

from mimic.motions.formats.episodes import ArmMotions, Episodes

STEPS, COUNT, DT = 6, 3, 0.1
EXPERT, LEARNER = ("joint1", "joint2", "joint3"), ("joint1", "joint2")


def motions(names, seed, *, commands=True):
    rng = np.random.default_rng(seed)
    qpos, qvel = rng.normal(size=(2, COUNT, STEPS + 1, len(names)))
    return ArmMotions("arm", names, qpos, qvel, rng.normal(size=(COUNT, STEPS, len(names))) if commands else None)


def episodes(*, robot=None, expert=True, steps=(6, 4, 6)) -> Any:  # its expert is not None where one is asked for
    return Episodes(
        DT, "imitate", robot or motions(LEARNER, 0), motions(EXPERT, 1) if expert else None, list(steps),
        ["train", "train", "held_out"], [0, 1, 0], {"source": "a test"},
    )  # fmt: skip
