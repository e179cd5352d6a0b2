"""Parts of the body that names of points state: tables of words, and one way to take a name apart.

Tools name either the joints of an arm (shoulder, elbow, wrist, hand) or its segments, by the joint where each begins
(collar or shoulder, arm, forearm, hand). Marker sets have several markers at a joint (lateral and medial), and some on
the segments between.
"""

import re
from collections.abc import Iterator, Sequence
from typing import NamedTuple

END = "_end"  # appended to the name of a joint for its end site, see `bvh`
INNER, OUTER = "inner", "outer"  # of two markers on both sides of a joint
_SIDES = {"l": "left", "left": "left", "lft": "left", "左": "left"}
_SIDES |= {"r": "right", "right": "right", "rgt": "right", "右": "right"}
# Words of a part, by how well they state its place: of several points those of the first line count.
_WORDS = {
    "shoulder": (
        "gh glenohumeral sjc shoulderjc shoulderjointcenter shoulderjointcentre",
        "shoulder sho shldr shld shoul should",
        "acromion acromium acrom acro acr acj saj sae caj ac",
    ),
    "upper_arm": ("upperarm uparm uarm humerus arm 腕",),
    "elbow": (
        "ejc elbowjc elbowjointcenter elbowjointcentre",
        "elbow elb elbo ひじ",
        "epicondyle humerusepicondyle humeralepicondyle epic",
    ),
    "forearm": ("forearm lowerarm lowarm loarm farm radius ulna",),
    "wrist": (
        "wjc wristjc wristjointcenter wristjointcentre",
        "wrist wri wr 手首",
        "styloid radiusstyloid styl radialstyloid ulnarstyloid ulnastyloid",
    ),
    "hand": ("fin fingerbase fingers", "hand hnd", "middle middlefinger mid handmiddle middleproximal finger 中指"),
    "index": ("index handindex indexfinger indexproximal",),
    "head": ("head headtop tophead fhd bhd hdf hdb nose forehead temple 頭",),
    "neck": ("neck c7 cv7 t1 clav sternum ster strn jugular ij 首",),
    "hip": ("hip hips pelvis midhip asis asi psis psi ias ips sacrum sacr upleg upperleg thigh",),
    "knee": ("knee kne fle fme leg lowerleg shin calf ひざ",),
    "foot": ("foot ankle ank fal tam fcc heel hee calc malleolus mall 足首",),
    "toe": ("toe toes toebase toetip toeend bigtoe fm1 fm5 mt5 つま先",),
}
# Codes that state which of two markers they are, of Plug-in Gait, ISB (Wu et al. 2005), CAST and others.
_PAIRS = {
    "elbow": {INNER: "em me mel hme", OUTER: "el le lel hle"},
    "wrist": {INNER: "wra rs rsp rad faradius mw", OUTER: "wrb us usp uhe uln faulna lw"},
    "hand": {INNER: "hm2", OUTER: "hm5"},
}
_PLACES = {INNER: "m med medial i in inner r radial", OUTER: "l lat lateral o out outer u ulnar"}
_IGNORED = {
    "study",
    "augmenter",
    "joint",
    "jnt",
    "marker",
    "bone",
    "root",
    "bend",
    "stretch",
    "top",
    "tip",
    "def",
    "org",
    "pos",
    "position",
}
_SHORTEST = 3  # letters of a word that others may stand before
_WORD = re.compile(
    r"[A-Z]{2,}(?=[a-z]\b)|[A-Z]+(?=[A-Z][a-z])|[A-Z]?[a-z]+|[A-Z]+|\d+|[左右]|[^\W\d_A-Za-z左右]+", re.UNICODE
)


class Part(NamedTuple):
    """What the name of a point states.

    Attributes:
      prefix: words before it, such as the name of a person.
      side: "left" or "right"; "" where it states none.
      part: a key of the table of words.
      rank: 0 where the word states the best place.
      place: `INNER` or `OUTER` side of the joint, or "".
      number: of several points with the same word.
    """

    prefix: str
    side: str
    part: str
    rank: int
    place: str = ""
    number: int = 0


def _known_words() -> dict[str, tuple[str, int, str]]:
    """Part, rank and place of each word, with the letters that state a place before or behind those of a joint."""
    known: dict[str, tuple[str, int, str]] = {}
    for part, ranks in _WORDS.items():
        for rank, word in ((rank, word) for rank, words in enumerate(ranks) for word in words.split()):
            known[word] = part, rank, ""
            if part not in ("elbow", "wrist") or not word.isascii():
                continue
            for place, marks in _PLACES.items():
                for mark in marks.split():
                    known.setdefault(f"{mark}{word}", (part, rank, place))
                    known.setdefault(f"{word}{mark}", (part, rank, place))
    for part, pair in _PAIRS.items():
        known |= {word: (part, 2, place) for place, words in pair.items() for word in words.split()}
    return known


_KNOWN = _known_words()
_PLACE_OF = {mark: place for place, marks in _PLACES.items() for mark in marks.split()}


def parts_of(names: Sequence[str]) -> list[Part | None]:
    """The part of the body that each name states; None where it states none."""
    endings: dict[str, set[str]] = {}
    for name in names:
        endings.setdefault(name[:-1], set()).add(name[-1:])
    # A last letter states a side, unless its counterpart is that of lateral and medial, or of radius and ulna.
    anatomical = [
        endings[name[:-1]] & {"l", "r"} == {name[-1:]} and bool(endings[name[:-1]] & {"m", "u"}) for name in names
    ]
    return [_part(name, *flag) for name, flag in zip(names, zip(anatomical, strict=True), strict=True)]


def is_twist(name: str) -> bool:
    """Whether a joint only rotates a part of a segment: its place is none of the body's joints."""
    word = "".join(word for word in _words(name) if word not in _SIDES).rstrip("0123456789")
    return "twist" in word or "捩" in word or word.startswith("roll") or word.endswith(("roll", "part"))


def is_thumb(name: str) -> bool:
    """Whether a point is on the thumb; of numbered fingers it is the first (3ds Max counts from 0)."""
    return bool(re.search("thumb|親指|finger_?0|finger1-1", name.lower()))


def _words(name: str) -> list[str]:
    return [word.lower() for word in _WORD.findall(re.split(r"[:|]", name)[-1])]


def _part(name: str, anatomical: bool) -> Part | None:
    if is_twist(name):
        return None
    words = _words(name.removesuffix(END))
    place = _PLACE_OF[words.pop()] if anatomical else ""
    side = next((word for word in words if word in _SIDES), "")
    if side:
        words.remove(side)
    found = _known_ending(words, has_side=bool(side))
    if found is None:
        return None
    part = found.part
    if name.endswith(END):  # the end site of the foot is the toe, and the others are no joints
        part = {"foot": "toe", "toe": "toe", "head": "head"}.get(part, "")
    namespace = " ".join([*re.split(r"[:|]", name)[:-1], found.prefix]).strip()
    return found._replace(
        prefix=namespace, side=_SIDES.get(side, found.side), part=part, place=place or found.place
    ) if part else None  # fmt: skip


def _known_ending(words: list[str], has_side: bool) -> Part | None:
    """The longest known word that the last of some words form, behind others that are no parts of the body.

    Words at the end that state its place or number, or nothing, do not belong to it.
    """
    place, number = "", 0
    for stop in range(len(words), 0, -1):
        for first in range(stop):
            joined = "".join(words[first:stop])
            if any(any(_readings(word, has_side)) for word in words[:first]) or (first and len(joined) < _SHORTEST):
                break
            for side, (part, rank, own_place) in _readings(joined, has_side):
                return Part(" ".join(words[:first]), side, part, rank, place or own_place, number)
        last = words[stop - 1]
        if last.isdigit():
            number = int(last[:6])
        elif last in _PLACE_OF:
            place = _PLACE_OF[last]
        elif last not in _IGNORED:
            break
    return None


def _readings(word: str, has_side: bool) -> Iterator[tuple[str, tuple[str, int, str]]]:
    """Side and meaning of a word, which may be written in one with its side: LSHO, leftforearm, ARML."""
    known = _KNOWN.get(word)
    if known and (has_side or not known[2]):
        yield "", known
    if not has_side:
        for without in (str.removeprefix, str.removesuffix):  # RELBL is the right elbow's lateral marker
            for mark, side in _SIDES.items():
                if (rest := without(word, mark)) != word and rest in _KNOWN:
                    yield side, _KNOWN[rest]
    if known:
        yield "", known
