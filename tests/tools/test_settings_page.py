"""``docs/settings.md`` says what the declarations say."""

from typing import Annotated

import msgspec

from semantic_mapper.config import Config
from semantic_mapper.setting_docs import Setting, settings_of
from tools.settings_page import PAGE, page


class _Inner(Config, frozen=True):
    """A table."""

    # Above, on
    # two lines ...
    size: Annotated[float, msgspec.Meta(gt=0, le=2)] = 1.0  # ... and behind.


class _Outer(Config, frozen=True):
    """With a table."""

    path: str
    inner: _Inner = _Inner()
    names: tuple[str, ...] = ()  # of all
    small: _Inner = _Inner(size=0.5)


def test_the_page_is_that_of_the_declarations() -> None:
    assert PAGE.read_text(encoding="utf-8") == page(), "python -m tools.settings_page"


def test_a_setting_is_described_by_the_comments_at_its_declaration() -> None:
    found = {setting.name: setting for setting in settings_of(_Outer)}
    assert found["inner.size"] == Setting("inner.size", float, 0, 2, 1.0, "Above, on two lines ... ... and behind.")
    assert found["inner.size"].kind == "number from 0 to 2" and found["names"].text == "of all"
    assert found["small.size"].default == 0.5
    assert found["path"].default is msgspec.NODEFAULT
