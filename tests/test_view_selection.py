import numpy as np

from semantic_mapper.geometry import select_views

EVEN = np.ones(3)
NOTHING = np.zeros(3)


def test_views_are_chosen_for_what_they_add():
    seen = np.array([[1, 1, 1, 0, 0], [1, 1, 0, 0, 0], [0, 0, 0, 1, 1]], bool)
    assert select_views(seen, EVEN, NOTHING, 2) == [0, 2]
    assert select_views(seen, EVEN, NOTHING, 9) == [0, 2, 1], "a second look at the same points is worth something"


def test_what_sees_nothing_is_never_chosen():
    seen = np.array([[1, 0], [0, 0], [0, 0]], bool)
    assert select_views(seen, EVEN, np.full(3, 5.0), 3) == [0]
    assert select_views(np.zeros((3, 4), bool), EVEN, EVEN, 3) == []
    assert select_views(np.zeros((3, 0), bool), EVEN, EVEN, 3) == []
