"""The measure of the project's size."""

from tools import house


def test_the_project_itself_is_measured() -> None:
    found = house.measure()
    assert found.keys() <= house.LIMITS.keys() and found["shipped lines"] > 10_000 and found["commands"] > 10
