"""Waiting times with the wheel alone, in an empty environment and an empty folder.

    python -m benchmarks.first_minutes [--out FILE] [--python PATH] [--default] [--note TEXT]

Installs a wheel of the last commit, whose versions pip chooses within the bounds; then trains, draws, and inspects and
trains the arm of docs/own_arm.md. `--default` adds the training of README.md. The home folder is new, so that nothing
is compiled before. Needs git and a package index. `benchmarks.newcomer` does the same with a clone and make.
"""

import itertools
import re
import subprocess
import sys
import tempfile
from pathlib import Path

from benchmarks.common.parser import make_parser
from benchmarks.common.processes import run_process
from benchmarks.common.record import collect
from benchmarks.newcomer import COLUMNS, INSTALL, REPOSITORY, Stage, run_stage

ARM = "crane.xml"
_PYTHON = "venv/bin/python"
_PIP = (_PYTHON, "-m", "pip")
_MIMIC = "venv/bin/mimic"
_OWN_ARM = (
    "env=pair",
    "env.expert=panda",
    f"env.learner={ARM}",
    "env.learner.armature=0.01",
    "env.learner.damping=0.1",
)
STAGES = (
    Stage("first command", (_MIMIC, "--version")),
    Stage("first figure", (_MIMIC, "figures", "only=[links]", "out=figures")),
    Stage(
        "first policy, short",
        (_MIMIC, "train", "env=planar4dof", "trainer.num_timesteps=500000", "run_dir=short"),
        "short",
    ),
    Stage("first video", (_MIMIC, "render", "run=short")),
    Stage("first own arm", (_MIMIC, "inspect", ARM, "out=inspected")),
    Stage("its policy, short", (_MIMIC, "train", *_OWN_ARM, "trainer.num_timesteps=500000", "run_dir=crane"), "crane"),
)
DEFAULT = Stage("first policy of the README", (_MIMIC, "train", "env=panda4dof", "run_dir=default"), "default")


def arm_of_page(page: str) -> str:
    """The model file that a page shows."""
    (model,) = re.findall(rf'^```xml title="{re.escape(ARM)}"\n(.*?)^```$', page, re.DOTALL | re.MULTILINE)
    return model


def build_wheel(folder: Path) -> str:
    """Name of a wheel of the last commit, in the folder `wheels` of a folder."""
    clone, wheels = folder / "clone", folder / "wheels"
    run_process(["git", "clone", "--quiet", str(REPOSITORY), str(clone)])
    run_process([sys.executable, "-m", "pip", "wheel", "--quiet", "--no-deps", "--wheel-dir", str(wheels), str(clone)])
    (wheel,) = wheels.glob("*.whl")
    return wheel.name


def installed_versions(folder: Path) -> dict[str, str]:
    """Versions of Python and of all that is installed in an environment."""
    code = "import platform; print(platform.python_version())"
    lines = subprocess.run([_PYTHON, "-c", code], cwd=folder, capture_output=True, text=True, check=True).stdout
    command = [*_PIP, "list", "--format", "freeze", "--disable-pip-version-check"]
    listed = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=True).stdout
    return {"python": lines.strip()} | dict(line.split("==") for line in listed.splitlines() if "==" in line)


def main() -> None:
    options = make_parser("first_minutes", __doc__, default=False, note="", python=sys.executable).parse_args()
    with tempfile.TemporaryDirectory() as temporary:
        folder, home = Path(temporary) / "work", Path(temporary) / "home"
        for new in (folder, home):
            new.mkdir()
        install = Stage(INSTALL.name, (*_PIP, "install", f"../wheels/{build_wheel(Path(temporary))}"))
        run_process([options.python, "-m", "venv", "venv"], cwd=folder)
        (folder / ARM).write_text(arm_of_page((REPOSITORY / "docs/own_arm.md").read_text()))
        first = run_stage(install, folder, home)
        installed = installed_versions(folder)
        stages = (*STAGES, DEFAULT) if options.default else STAGES
        rows = itertools.chain([first], (run_stage(stage, folder, home) for stage in stages))
        collect(options, rows, "stages", COLUMNS, note=options.note, installed=installed)


if __name__ == "__main__":
    main()
