"""Which chains of two embodiments correspond: left to left and thumb to thumb, or in their order."""

import re
from collections.abc import Sequence

from mimic.arms.names import side, words

_FINGERS = ("thumb", "index", "middle", "ring", "little")
_CODES: dict[str, str] = dict(zip(("th", "ff", "mf", "rf", "lf"), _FINGERS, strict=True))  # of the Shadow hand
_OTHER_WORDS = {"pinky": "little", "pinkie": "little", "forefinger": "index"}
_ENDS = "|".join(("", "tip", "distal", "j"))  # what follows the code of a finger


def matched_chains(expert: Sequence[str], learner: Sequence[str]) -> tuple[tuple[int, int], ...]:
    """Pairs of chains (expert, learner) that correspond.

    These are the chains whose names have the same side and finger, where only one chain of each embodiment has
    them: left_hand and l_wrist, thumb and robot0:thdistal. Chains without a counterpart stay alone. Where no names
    match, it is the first with the first, and so on.

    Args:
      expert: names of the expert's chains.
      learner: names of the learner's chains.

    Raises:
      ValueError: numbers of chains that differ where no names match.
    """
    sides = [[_label(name) for name in names] for names in (expert, learner)]
    unique = [label for label in sides[0] if any(label) and all(labels.count(label) == 1 for labels in sides)]
    if unique:
        return tuple((sides[0].index(label), sides[1].index(label)) for label in unique)
    if len(expert) != len(learner):
        raise ValueError(
            f"chains: expected as many chains of the expert as of the learner, or names with the same sides or "
            f"fingers, got {', '.join(expert)} and {', '.join(learner)}"
        )
    return tuple((index, index) for index in range(len(expert)))


def _label(name: str) -> tuple[str, str]:
    """Side and finger of a chain, empty where its name has none."""
    return side(name), next(filter(None, map(_finger, words(name))), "")


def _finger(word: str) -> str:
    for start, finger in [*((finger, finger) for finger in _FINGERS), *_OTHER_WORDS.items()]:
        if word.startswith(start):
            return finger
    code = re.fullmatch(f"({'|'.join(_CODES)})({_ENDS})", word)
    return _CODES[code[1]] if code else ""
