"""The installed package is found from every folder."""

import os
import subprocess
import sys


def test_mimic_is_imported_next_to_a_clone(tmp_path):
    """A folder named mimic without an `__init__.py`, as a clone is, must not be taken for the package."""
    (tmp_path / "mimic").mkdir()
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    code = "import mimic\nassert mimic.__file__, 'an empty package: install mimic again, with make install'"
    command = [sys.executable, "-c", code]
    result = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True, check=False)
    assert result.returncode == 0, result.stderr[-2000:]
