"""A phrase such as "the red chair near the table in the kitchen, last seen before noon" as what it asks for.

A thing is a class or a synonym of one, after colours and sizes; behind it come relations to other things, rooms, and
when it was seen. ``words.toml`` has the words. Words without meaning here ("where is my") are passed over; any other
word is an error, so that nothing is left out of an answer unnoticed."""

import difflib
import re
import tomllib
from collections.abc import Mapping
from dataclasses import dataclass
from datetime import datetime, timedelta
from pathlib import Path
from typing import Any

from semantic_mapper.errors import MapError
from semantic_mapper.labels import PLAIN_NAMES, LabelSet
from semantic_mapper.queries.text_encoder import TextEncoder, class_weights

_WORDS: dict[str, dict[str, Any]] = tomllib.loads((Path(__file__).parent / "words.toml").read_text(encoding="utf-8"))
SYNONYMS: Mapping[str, str] = _WORDS["synonyms"]
COLORS: Mapping[str, str] = _WORDS["colors"]
ROOM_KINDS: Mapping[str, Mapping[str, float]] = _WORDS["room_kinds"]
RELATIONS: Mapping[str, str] = _WORDS["relations"]
OTHER_WEIGHT = 0.15  # of a class of many kinds of things, for a word that means one of them
_COLORS = {w: name for name, words in _WORDS["color_synonyms"].items() for w in words.split()} | {c: c for c in COLORS}
_SIZES = {
    word: (key.strip("-"), -step if key[0] == "-" else step)
    for table, step in (("sizes", 1), ("superlatives", 2))
    for key, words in _WORDS[table].items()
    for word in words.split()
}
_SHADES = {word: 1 if name == "light" else -1 for name, words in _WORDS["shades"].items() for word in words.split()}
_KINDS = {name.replace(" ", ""): name for name in ROOM_KINDS}
_KINDS |= {word: name for name, words in _WORDS["room_synonyms"].items() for word in words.split()}
_RELATIONS = {word: name for name, words in RELATIONS.items() for word in words.split("|")}
_RELATION = re.compile(rf"\b({'|'.join(sorted(_RELATIONS, key=lambda word: -len(word)))})\b")
_REFUSED = re.compile(r"\b(left of|right of|behind|in front of|opposite|between|far from|without|not)\b")
_FILLER = frozenset(
    "a an the my our your me us please find show get fetch where is are was were do did does you i we it that which "
    "there of to go what who some any one last see saw seen lately stands standing lies lying and s".split()
)
_CLOCK = r"(?P<clock>noon|midnight|\d{1,2}(?::\d\d)?(?: ?[ap]m)?)"
_DAY = r"(?:(?P<when>before|until|after|since|on) )?(?P<day>today|yesterday|\d{4}-\d\d-\d\d)"
_DATED = re.compile(rf"\b{_DAY}(?: at)?(?: {_CLOCK})?(?= |$)")
_TODAY = re.compile(rf"\b(?P<when>before|until|after|since) {_CLOCK}(?= |$)")
_LAST_SEEN = re.compile(r"\blast\s+(saw|see|seen)\b", re.IGNORECASE)
_LAST = re.compile(r"\b(?:in|within) the (?:last|past) (?P<n>\d+ )?(?P<unit>minute|hour|day|week)s?\b")
_UNITS_NS = {"minute": 60 * 10**9, "hour": 3600 * 10**9, "day": 86_400 * 10**9, "week": 604_800 * 10**9}


@dataclass(frozen=True, slots=True)
class NounPhrase:
    """A thing by what it is and what it looks like."""

    text: str
    classes: Mapping[int, float]  # class id -> how well the words mean it, above 0, at most 1
    colors: tuple[str, ...] = ()  # of ``COLORS``
    # "size", "height" or "length"; 1 = more of it than usual, -1 = less, 2 = the most of all that fit, -2 = the least
    sizes: tuple[tuple[str, int], ...] = ()
    shade: int = 0  # of the colours: 1 = light, -1 = dark, 0 = any


@dataclass(frozen=True, slots=True)
class Phrase:
    """What a phrase asks for."""

    thing: NounPhrase
    relations: tuple[tuple[str, NounPhrase], ...] = ()  # of ``RELATIONS``
    rooms: tuple[int | str, ...] = ()  # ids, or kinds of ``ROOM_KINDS``
    last: bool = False  # where it was last seen is asked, be it there still or not
    # after_ns, before_ns: Last seen then; None = any time.
    after_ns: int | None = None
    before_ns: int | None = None


def read_phrase(text: str, labels: LabelSet, now_ns: int, encoder: TextEncoder | None = None) -> Phrase:
    """What a phrase asks for, of a map with these classes.

    Clock times are local, of the day of ``now_ns``. With an ``encoder``, what is no colour, size or other word of the
    grammar names a thing, for which it scores the classes. Raises MapError: no thing, a word that is not known (names
    the nearest that are), or what cannot be answered."""
    plain = " ".join(re.findall(r"\d{4}-\d\d-\d\d|\d{1,2}:\d\d|[^\W_]+", text.casefold()))
    plain, after_ns, before_ns = _read_times(plain, now_ns)
    if refused := _REFUSED.search(plain):
        raise MapError(f"find: '{refused[1]}' cannot be answered; relations are {', '.join(RELATIONS)}")
    nouns = _nouns(labels)
    first, *rest = _RELATION.split(plain)
    relations, rooms = list[tuple[str, NounPhrase]](), list[int | str]()
    for word, noun in zip(rest[::2], rest[1::2], strict=True):
        what = [w for w in noun.split() if w not in _FILLER]
        room = re.fullmatch(r"room (\d{1,9})", " ".join(what))
        kind = _KINDS.get("".join(what)) if word == "in" else None
        if what == ["room"]:  # any
            continue
        if room or kind:
            rooms.append(int(room[1]) if room else kind or "")
        elif what:
            relations.append((_RELATIONS[word], _read_noun(what, labels, nouns, encoder)))
        elif word != "at":  # "where is the cup at"
            raise MapError(f"find: '{word}' needs a thing{' or a room' * (word == 'in')} behind it")
    words = [w for w in first.split() if w not in _FILLER] or ["thing"] * bool(relations or rooms)
    thing = _read_noun(words, labels, nouns, encoder)
    return Phrase(thing, tuple(relations), tuple(rooms), bool(_LAST_SEEN.search(text)), after_ns, before_ns)


def _nouns(labels: LabelSet) -> dict[str, dict[int, float]]:
    """Words for things, folded, and the classes that they mean."""
    nouns, of_name = dict[str, dict[int, float]](), dict(zip(labels.names, labels.ids, strict=True))
    for words, names in SYNONYMS.items():
        there = [n for n in names.strip("+").split() if n in of_name][: None if names[0] == "+" else 1]
        classes = {of_name[n]: OTHER_WEIGHT if n.startswith("other") else 1.0 for n in there}
        nouns |= {_folded(word): classes for word in words.split() if classes}
        nouns |= {word: dict.fromkeys(labels.ids, 1.0) for word in words.split() if names == "+"}
    titles = {title: number for name, number in of_name.items() for title in (name, PLAIN_NAMES.get(name, name))}
    return nouns | {_folded(re.sub(r"[\W_]", "", title.casefold())): {n: 1.0} for title, n in titles.items()}


def _read_noun(
    words: list[str], labels: LabelSet, nouns: Mapping[str, Mapping[int, float]], encoder: TextEncoder | None
) -> NounPhrase:
    text, found = " ".join(words), list[str]()
    colors, sizes, shade = list[str](), list[tuple[str, int]](), 0
    while words:
        joined = [("".join(words[:n]), n) for n in (3, 2, 1) if n <= len(words)]
        word, n = next((j for j in joined if _folded(j[0]) in nouns), joined[-1]) if encoder is None else joined[-1]
        words = words[n:]
        if word in _SHADES and words:  # "light" alone is a thing
            shade = _SHADES[word]
        elif word in _COLORS:
            colors.append(_COLORS[word])
        elif word in _SIZES:
            sizes.append(_SIZES[word])
        elif encoder is None and _folded(word) not in nouns:
            known = [*nouns, *_COLORS, *_SIZES, *_KINDS, *_RELATIONS]
            near = difflib.get_close_matches(_folded(word), dict.fromkeys(known), n=3, cutoff=0.6)
            hint = f"did you mean {' or '.join(near)}?" if near else f"things are {', '.join(labels.names)}"
            hint = f"of a room say 'in the {word}'" if word in _KINDS else hint
            raise MapError(f"find: '{word}' is not known; {hint}")
        else:
            found.append(word)
    if not found:
        raise MapError(f"find: '{text}' names no thing; 'thing' stands for any")
    if encoder is not None and found != ["thing"]:
        classes: Mapping[int, float] = class_weights(" ".join(found), labels, encoder)
    elif len(found) > 1:
        raise MapError(f"find: '{found[0]}' and '{found[1]}' are two things; say how they lie: {', '.join(RELATIONS)}")
    else:
        classes = nouns[_folded(found[0])]
    return NounPhrase(text, classes, tuple(colors), tuple(sizes), shade)


def _folded(word: str) -> str:
    """A noun in the singular, roughly; known words and those of a phrase alike."""
    for end, single in (("ies", "y"), ("lves", "lf"), ("xes", "x"), ("shes", "sh"), ("ches", "ch"), ("sses", "ss")):
        if word.endswith(end) and len(word) > len(end) + 1:
            return word[: -len(end)] + single
    return word[:-1] if word.endswith("s") and not word.endswith("ss") and len(word) > 3 else word


def _read_times(text: str, now_ns: int) -> tuple[str, int | None, int | None]:
    """The text without its times, and the stamps after and before which the thing was seen."""
    after: int | None = None
    before: int | None = None
    while found := _LAST.search(text) or _DATED.search(text) or _TODAY.search(text):
        text = f"{text[: found.start()]} {text[found.end() :]}"
        if found.re is _LAST:
            after = now_ns - int(found["n"] or 1) * _UNITS_NS[found["unit"]]
            continue
        start, end = _moment(found, now_ns)
        if found["when"] in ("before", "until"):
            before = start
        else:
            after = end if found["when"] == "after" and not found["clock"] else start
            before = end if found["when"] in (None, "on") else before
    return " ".join(text.split()), after, before


def has_date(stamp_ns: int) -> bool:
    """Whether a stamp counts from 1970 (it is after 2000), and not from the start of a device."""
    return stamp_ns >= 946_684_800 * 10**9


def _moment(found: re.Match[str], now_ns: int) -> tuple[int, int]:
    """First and last stamp of what is meant: a day, or a minute."""
    if not has_date(now_ns):
        raise MapError("find: the stamps of this map are no dates; ask 'in the last 10 minutes'")
    at, named, clock = datetime.fromtimestamp(now_ns // 10**9), found.groupdict().get("day"), found["clock"]
    at = at.replace(hour=0, minute=0, second=0)
    try:
        at = at - timedelta(days=named == "yesterday")
        at = datetime.fromisoformat(named) if named and named[0].isdigit() else at
        if clock is None:
            return _stamp(at), _stamp(at + timedelta(days=1))
        hour, _, minute = re.sub(r" ?[ap]m", "", {"noon": "12", "midnight": "0"}.get(clock, clock)).partition(":")
        half = 12 * (clock.endswith("pm") - (clock[-1] == "m" and hour == "12"))
        at = at.replace(hour=int(hour) + half, minute=int(minute or 0))
        at += timedelta(days=clock == "midnight" and found["when"] in ("before", "until"))  # the end of the day
    except (ValueError, OverflowError) as error:
        raise MapError(f"find: '{found[0].strip()}' is no time: {error}") from error
    return _stamp(at), _stamp(at + timedelta(minutes=1))


def _stamp(at: datetime) -> int:
    return round(at.timestamp()) * 10**9
