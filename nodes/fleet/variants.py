"""Results of a store that belong together: one operation with the same code, weights and settings."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import msgspec

from semantic_mapper.errors import ConfigError
from semantic_mapper.nodes.fleet.tables import Tables
from semantic_mapper.plain_text import counted

_COLUMNS = "key, log, log_digest, version, code, weights, weights_digest, settings, epoch_us(finished) AS finished_us"


DEFAULT_WEIGHTS = "default"  # what people are shown and write for weights that were not named


@dataclass(frozen=True, slots=True)
class Variant:
    """One way in which an operation was run.

    Args:
        version, weights: For people, of the latest result; no weights = those that ship with the package.
        code, weights_digest: Of contents.
        settings: What ``--set`` said; ``settings_text`` is that as the tables have it.
        finished_us: When the latest result was finished, microseconds since 1970.
        keys: Of results, by digest of the log.
        logs: URLs, by digest of the log.
    """

    version: str
    weights: str
    code: str
    weights_digest: str
    settings: Mapping[str, Any]
    settings_text: str
    finished_us: int
    keys: Mapping[str, str] = field(repr=False)
    logs: Mapping[str, str] = field(repr=False)

    def describe(self) -> str:
        """For people, on one line."""
        if not self.keys:
            return ", ".join([*([self.version] if self.version else []), "no results"])
        settings = [f"{name}={_written(value)}" for name, value in sorted(self.settings.items())]
        return ", ".join([self.version, f"weights {self.weights or DEFAULT_WEIGHTS}", *settings])

    def condition(self, operation: str) -> str:
        """Of SQL, for rows of ``logs``."""
        wanted = {"operation": operation, "code": self.code, "weights_digest": self.weights_digest}
        wanted["settings"] = self.settings_text
        return "(" + " AND ".join(f"{name} = {quoted(value)}" for name, value in wanted.items()) + ")"

    def is_meant(self, wanted: Mapping[str, str]) -> bool:
        """Whether each name has its value: "version" and "code" begin with it, "weights" are it, settings equal it."""
        return all(self._has(name, value) for name, value in wanted.items())

    def _has(self, name: str, value: str) -> bool:
        if name == "version":
            return self.version.startswith(value)
        if name == "code":
            return self.code.startswith(value)
        if name == "weights":
            return value == (self.weights or DEFAULT_WEIGHTS) or self.weights_digest.startswith(value)
        return name in self.settings and _written(self.settings[name]) == value


def _written(value: Any) -> str:
    """A setting as ``--set`` takes it."""
    return value if isinstance(value, str) else msgspec.json.encode(value).decode()


def failed_variant(version: str) -> Variant:
    """A variant without results; ``version`` may be empty."""
    return Variant(version, "", "", "", {}, "{}", 0, {}, {})


def quoted(text: str) -> str:
    """As a text of SQL."""
    return "'" + text.replace("'", "''") + "'"


def operations(tables: Tables) -> list[str]:
    """Those with results, the one with most of them first."""
    rows = tables.query("SELECT operation FROM logs GROUP BY operation ORDER BY count(*) DESC, operation").to_pylist()
    return [row["operation"] for row in rows]


def variants(tables: Tables, operation: str) -> list[Variant]:
    """All variants of an operation, the latest first."""
    found = tables.query(
        f"SELECT {_COLUMNS} FROM logs WHERE operation = {quoted(operation)} ORDER BY finished DESC, key"
    )
    groups: dict[tuple[str, str, str], list[dict[str, Any]]] = {}
    for row in found.to_pylist():
        groups.setdefault((row["code"], row["weights_digest"], row["settings"]), []).append(row)
    return [_variant(rows) for rows in groups.values()]


def _variant(rows: Sequence[dict[str, Any]]) -> Variant:
    """Of its results, the latest first."""
    latest = rows[0]
    return Variant(
        latest["version"],
        latest["weights"],
        latest["code"],
        latest["weights_digest"],
        msgspec.json.decode(latest["settings"]),
        latest["settings"],
        latest["finished_us"],
        {row["log_digest"]: row["key"] for row in reversed(rows)},
        {row["log_digest"]: row["log"] for row in reversed(rows)},
    )


def choose_variant(tables: Tables, operation: str, wanted: Mapping[str, str]) -> Variant:
    """The latest variant that is meant.

    Raises:
        ConfigError: the store has no such variant.
    """
    found = variants(tables, operation)
    meant = [variant for variant in found if variant.is_meant(wanted)]
    if meant:
        return meant[0]
    text = ", ".join(f"{name}={value}" for name, value in wanted.items())
    if not found:
        raise ConfigError(f"{tables.store.shown}: has no results of `{operation}`; `fleet run {operation}` makes them")
    there = "; ".join(f"{v.describe()} ({counted(len(v.keys), 'log')})" for v in found[:8])
    raise ConfigError(f"{tables.store.shown}: no results of `{operation}` have {text}; there are: {there}")
