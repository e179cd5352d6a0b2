"""The list of slow parameters names tests that exist, and no test as a whole."""

from tests.helpers.repository import REPOSITORY, SLOW_PARAMETERS


def test_each_line_is_a_parameter_of_a_test():
    lines = SLOW_PARAMETERS.read_text().splitlines()
    assert lines == sorted(set(lines)) and len(lines) > 50
    for line in lines:
        file, _, test = line.partition("::")
        name, bracket, _ = test.partition("[")
        assert bracket and line.endswith("]"), line
        assert f"\ndef {name}(" in (REPOSITORY / file).read_text(), line
