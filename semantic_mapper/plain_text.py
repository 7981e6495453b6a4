"""Text from files and sockets, made safe to show: names in it may hold anything."""

from __future__ import annotations


def counted(count: int, one: str, many: str = "") -> str:
    """A number of things: 1 frame, 2 frames; ``many`` where it is not ``one`` with an s."""
    return f"{count} {one}" if count == 1 else f"{count} {many or one + 's'}"


def visible(text: str, keep: str = "") -> str:
    r"""The text with every character that prints nothing, or steers what shows it, as an escape such as ``\x1b``.

    These are control characters (terminal commands, line breaks, tabs), those that turn the direction of writing, and
    halves of surrogate pairs, as file names that are not UTF-8 hold them.

    Args:
        text: Any.
        keep: Characters that stay as they are.
    """
    if text.isprintable():
        return text
    return "".join(c if c.isprintable() or c in keep else c.encode("unicode_escape").decode("ascii") for c in text)
