"""Failures that are no bug of ours, in one line: of the machine, and of what people name and type."""

from __future__ import annotations

from semantic_mapper.memory import is_out_of_memory, memory_message


def failure_message(error: BaseException) -> str:
    """What a failure says to people; empty where it is a bug, whose traceback is worth more.

    Args:
        error: None of ours, which say all that is to be said.
    """
    if is_out_of_memory(error):  # native packages raise whatever they like then
        return memory_message(error)
    if isinstance(error, OSError):  # disk full, permission denied: the system's own words and the file
        return f"{error.filename}: {error.strerror}" if error.filename else str(error)
    if isinstance(error, ValueError) and "embedded null" in str(error):
        return "a name holds a NUL character, which no file and no address may; give another name"
    if isinstance(error, ValueError) and "integer string conversion" in str(error):
        return "a whole number has more than 4,300 digits; no value may have so many"
    return ""
