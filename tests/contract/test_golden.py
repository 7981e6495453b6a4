"""Golden data is all there, and small."""

from tests.contract.golden import FOLDER, LOG, MAP, MAP_COARSE, POINTS, STORED, WEIGHTS
from tests.contract.record import GROUPS

MOST_BYTES = 1_500_000


def test_every_group_is_recorded() -> None:
    for group in GROUPS:
        assert (FOLDER / f"{group}.json").is_file()
    for path in (LOG, MAP, MAP_COARSE, POINTS, STORED / "summary.json", WEIGHTS):
        assert path.is_file()


def test_golden_data_is_small() -> None:
    assert sum(path.stat().st_size for path in FOLDER.rglob("*") if path.is_file()) < MOST_BYTES
