"""Share of the URDF files in folders that load, by cause, beside pinocchio where it is installed.

    python -m benchmarks.models FOLDER [FOLDER ...] [--out FILE] [--min-joints 2]

Files with the same content count once. An arm is a file with a chain of at least `--min-joints` revolute joints.
`loads` counts files that load as they are, `with_tip` those that branch and load with the tip that the line names.
Numbers, names and paths in the lines of the other files are replaced by "…", so that equal causes count together.
"""

import argparse
import hashlib
import logging
import re
import sys
from collections import Counter
from collections.abc import Iterator, Sequence
from pathlib import Path
from types import ModuleType
from xml.etree import ElementTree

import mimic
from benchmarks.common.parser import make_parser
from benchmarks.common.record import Row, print_table, write_results

COLUMNS = "files arms loads with_tip pinocchio pinocchio_arms of_these loads_of_these:.1%"
_VARIABLE = re.compile(r"'[^']*'|\"[^\"]*\"|\S*/\S*|[-+]?\d+(?:\.\d+)?(?:e[-+]?\d+)?")
_LONGEST_CAUSE = 110  # characters
_TIP = re.compile(r"name one, as in tip=(.+?), several")
_LOADS, _WITH_TIP = "loads", "loads with tip="


def urdf_files(folders: Sequence[Path]) -> Iterator[Path]:
    """The URDF files of folders, one of each content."""
    known: set[str] = set()
    for file in (file for folder in folders for file in sorted(folder.rglob("*.urdf")) if file.is_file()):
        digest = hashlib.sha256(file.read_bytes()).hexdigest()
        if digest not in known:
            known.add(digest)
            yield file


def longest_chain(file: Path) -> int:
    """Number of revolute joints on the longest chain of a URDF; 0 for a file that is no XML."""
    try:
        root = ElementTree.fromstring(file.read_bytes())
    except ElementTree.ParseError:
        return 0
    parents: dict[str, tuple[str, bool]] = {}
    for joint in root.findall("joint"):
        child, parent = (element.get("link", "") if (element := joint.find(tag)) is not None else ""
                         for tag in ("child", "parent"))  # fmt: skip
        parents[child] = parent, joint.get("type") in ("revolute", "continuous")
    longest = 0
    for link in parents:
        count, visited = 0, {link}
        while link in parents:
            link, is_revolute = parents[link]
            count += is_revolute
            if link in visited:
                break
            visited.add(link)
        longest = max(longest, count)
    return longest


def cause(file: Path) -> str:
    """`loads`, or why mimic rejects a file."""
    try:
        mimic.load_mjcf(file)
    except ValueError as error:
        message = str(error)
    else:
        return _LOADS
    if tip := _TIP.search(message):
        try:
            mimic.load_mjcf(file, tip=tip[1])
        except ValueError as error:
            message = str(error)
        else:
            return _WITH_TIP
    return _VARIABLE.sub("…", message.replace(str(file), "…"))[:_LONGEST_CAUSE]


def reads_with(pinocchio: ModuleType | None, file: Path) -> bool:
    """Whether pinocchio builds a model of a file."""
    if pinocchio is None:
        return False
    try:
        pinocchio.buildModelFromUrdf(str(file))
    except Exception:  # of C++, of several kinds
        return False
    return True


def summary(rows: Sequence[Row]) -> Row:
    """Counts of files, and the share that loads of the arms that pinocchio reads."""
    both = [row for row in rows if row["is_arm"] and row["pinocchio"]]
    loaded = sum(row["cause"] in (_LOADS, _WITH_TIP) for row in both)
    return {
        "files": len(rows),
        "arms": sum(row["is_arm"] for row in rows),
        "loads": sum(row["cause"] == _LOADS for row in rows),
        "with_tip": sum(row["cause"] == _WITH_TIP for row in rows),
        "pinocchio": sum(row["pinocchio"] for row in rows),
        "pinocchio_arms": len(both),
        "of_these": loaded,
        "loads_of_these": loaded / len(both) if both else None,
    }


def main(arguments: Sequence[str] | None = None) -> None:
    parser = make_parser("models", __doc__, min_joints=2)
    parser.add_argument("folders", nargs="+", type=Path, metavar="FOLDER")
    options: argparse.Namespace = parser.parse_args(arguments)
    logging.getLogger("mimic").setLevel(logging.ERROR)
    try:
        import pinocchio  # pyright: ignore[reportMissingImports]  # not among the packages of the project
    except ImportError:
        pinocchio = None
    rows: list[Row] = []
    for number, file in enumerate(urdf_files(options.folders), start=1):
        is_arm = longest_chain(file) >= options.min_joints
        row = {"file": str(file), "is_arm": is_arm, "cause": cause(file), "pinocchio": reads_with(pinocchio, file)}
        rows.append(row)
        print(f"{number}: {file.name}: {row['cause']}", file=sys.stderr, flush=True)
    counts = Counter((row["cause"], row["is_arm"]) for row in rows)
    causes = [{"count": count, "arm": arm, "cause": text} for (text, arm), count in counts.most_common()]
    print_table([summary(rows)], COLUMNS)
    print_table(causes, "count arm cause")
    write_results(options, **summary(rows), causes=causes)


if __name__ == "__main__":
    main()
