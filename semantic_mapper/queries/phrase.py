"""A phrase such as "the red chair near the table in the kitchen, last seen before noon" as what it asks for.

It is a thing, and any of: relations to other things, rooms, when it was seen. A thing is a class or a synonym of one
(``SYNONYMS``), with colours and sizes before it. Words without meaning here ("where is my") are passed over; any other
word is an error, so that nothing is left out of an answer unnoticed."""

import difflib
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from datetime import datetime, timedelta

from semantic_mapper.errors import MapError
from semantic_mapper.labels import PLAIN_NAMES, LabelSet
from semantic_mapper.queries.text_encoder import TextEncoder, class_weights

# Words of one meaning, and the classes that they stand for: the first that the label set has; after "+", all.
SYNONYMS = {
    "thing object item something anything stuff": "+",
    "furniture": "+cabinet bed chair sofa table bookshelf desk shelves dresser nightstand otherfurniture",
    "seat": "+chair sofa",
    "vehicle": "+car caravan trailer truck bus",
    "couch settee loveseat": "sofa",
    "stool armchair officechair deskchair diningchair": "chair",
    "coffeetable diningtable kitchentable sidetable endtable": "table",
    "desk workbench writingdesk": "desk table",
    "cupboard wardrobe closet sideboard locker drawers": "cabinet otherfurniture",
    "dresser chestofdrawers": "dresser cabinet otherfurniture",
    "nightstand bedsidetable": "nightstand cabinet table otherfurniture",
    "bookcase bookshelf": "bookshelf shelves",
    "shelf rack": "shelves bookshelf",
    "worktop countertop kitchencounter island": "counter",
    "fridge freezer refrigerator": "refrigerator otherfurniture",
    "oven stove cooker dishwasher washingmachine microwave": "otherfurniture otherprop",
    "bath tub": "bathtub",
    "wc loo": "toilet",
    "basin washbasin": "sink",
    "doorway entrance": "door",
    "drape": "curtain",
    "blind shutter": "blinds curtain",
    "poster painting photo print": "picture",
    "rug carpet mat": "floormat otherprop floor",
    "monitor screen tv telly television": "television otherprop",
    "light lamp": "lamp otherprop otherfurniture",
    "cushion pillow": "pillow otherprop",
    "book": "books otherprop",
    "backpack handbag suitcase bag": "bag otherprop",
    "carton crate box": "box otherprop",
    "mirror": "mirror otherprop",
    "towel": "towel otherprop",
    "clothing jacket coat": "clothes otherprop",
    "paper document": "paper otherprop",
    "cup mug bottle glass plate bowl pan pot vase plant flower laptop computer keyboard mouse phone remote toy ball "
    "shoe bin basket clock fan heater kettle toaster": "otherprop",
    "person people human man woman child somebody": "person pedestrian",
    "cyclist rider": "bicyclist",
    "automobile van": "car",
    "house tower": "building",
    "post": "pole",
    "signpost roadsign": "sign trafficsign signsymbol",
    "pavement sidewalk": "sidewalk sidewalks pavement",
    "street": "road roads",
    "bush plant": "vegetation tree",
}
OTHER_WEIGHT = 0.15  # of a class of many kinds of things, for a word that means one of them
# sRGB of colours that a name stands for.
COLORS = {
    "black": "111111 242424",
    "white": "f8f8f8 e4e4e4",
    "gray": "808080 a4a4a4 5c5c5c c4c4c4",
    "red": "d02020 8c1c1c b04040",
    "orange": "f08020 c86a28",
    "yellow": "f0dc30 c8b040",
    "green": "209040 60a050 205030 90c070",
    "turquoise": "30b0b0 207878 80d0c8",
    "blue": "2050c0 203060 5080b0 90b8e0",
    "purple": "8040b0 503070 a080c0",
    "pink": "f080b0 e0a0b8 c05080",
    "brown": "704828 4c3420 946848",
    "beige": "d8c8a0 c0a880",
}
COLOR_SYNONYMS = {"grey": "gray", "silver": "gray", "teal": "turquoise", "cyan": "turquoise", "violet": "purple"}
COLOR_SYNONYMS |= {"magenta": "pink", "cream": "beige", "tan": "beige", "golden": "yellow", "navy": "blue"}
SHADES = {"dark": -1, "light": 1, "bright": 1, "pale": 1}
# What is measured, and whether more (1) or less (-1) of it than the median of its class is meant.
SIZES = {"big": ("size", 1), "large": ("size", 1), "huge": ("size", 1), "small": ("size", -1), "little": ("size", -1)}
SIZES |= {"tiny": ("size", -1), "tall": ("height", 1), "high": ("height", 1), "short": ("height", -1)}
SIZES |= {"low": ("height", -1), "long": ("length", 1), "wide": ("length", 1), "narrow": ("length", -1)}
# Classes that rooms of a kind have, with weights; a room of which nothing is known is of no kind.
ROOM_KINDS: Mapping[str, Mapping[str, float]] = {
    "kitchen": {"refrigerator": 3, "counter": 3, "sink": 1, "cabinet": 0.3},
    "bathroom": {"toilet": 4, "bathtub": 3, "showercurtain": 3, "sink": 1, "towel": 1},
    "bedroom": {"bed": 4, "nightstand": 2, "dresser": 1, "pillow": 0.5},
    "living room": {"sofa": 3, "television": 1.5, "bookshelf": 0.5, "table": 0.3},
    "office": {"desk": 2, "whiteboard": 2, "bookshelf": 0.5, "chair": 0.2},
}
_KINDS = {name.replace(" ", ""): name for name in ROOM_KINDS} | {"toilet": "bathroom", "lounge": "living room"}
_KINDS |= {"study": "office", "livingroom": "living room"}
RELATIONS = {
    "near": "near|nearby|next to|close to|beside|by|at|with",
    "on": "on top of|upon|on",
    "under": "underneath|under|below|beneath",
    "above": "above|over",
    "in": "inside|within|in",
}
_REFUSED = "left of|right of|behind|in front of|opposite|between|far from|without|not"
_FILLER = frozenset(
    "a an the my our your me us please find show get fetch where is are was were do did does you i we it that which "
    "there of to go what who some any one colored coloured last see saw seen lately stands standing lies lying and s"
    "".split()
)
_CLOCK = r"noon|midnight|\d{1,2}(?::\d\d)?(?: ?[ap]m)?"
_DAY = r"today|yesterday|\d{4}-\d\d-\d\d"
_DATED = re.compile(
    rf"\b(?:(?P<when>before|until|after|since|on) )?(?P<day>{_DAY})(?: at)?(?: (?P<clock>{_CLOCK}))?(?= |$)"
)
_TODAY = re.compile(rf"\b(?P<when>before|until|after|since) (?P<clock>{_CLOCK})(?= |$)")
_LAST = re.compile(r"\b(?:in|within) the (?:last|past) (?P<n>\d+ )?(?P<unit>minute|hour|day|week)s?\b")
_FIRST_DATE_NS = 946_684_800 * 10**9  # 2000-01-01: earlier stamps count from the start of a device


@dataclass(frozen=True, slots=True)
class NounPhrase:
    """A thing by what it is and what it looks like."""

    text: str
    classes: Mapping[int, float]  # class id -> how well the words mean it, above 0, at most 1
    colors: tuple[str, ...] = ()  # of ``COLORS``
    shade: int = 0  # -1 = dark, 1 = light
    sizes: tuple[tuple[str, int], ...] = ()  # as of ``SIZES``


@dataclass(frozen=True, slots=True)
class Phrase:
    """What a phrase asks for."""

    thing: NounPhrase
    relations: tuple[tuple[str, NounPhrase], ...] = ()  # of ``RELATIONS``
    rooms: tuple[int | str, ...] = ()  # ids, or kinds of ``ROOM_KINDS``
    # after_ns, before_ns: Last seen then; None = any time.
    after_ns: int | None = None
    before_ns: int | None = None


def read_phrase(text: str, labels: LabelSet, now_ns: int, encoder: TextEncoder | None = None) -> Phrase:
    """What a phrase asks for, of a map with these classes.

    Clock times are local, of the day of ``now_ns``. With an ``encoder``, what is no colour, size or other word of the
    grammar is a name of any thing, whose classes it scores. Raises MapError: no thing, a word that is not known (names
    the nearest that are), or what cannot be answered."""
    plain = " ".join(re.findall(r"\d{4}-\d\d-\d\d|\d{1,2}:\d\d|[^\W_]+", text.casefold()))
    plain, after_ns, before_ns = _read_times(plain, now_ns)
    if found := re.search(rf"\b({_REFUSED})\b", plain):
        raise MapError(f"find: '{found[1]}' cannot be answered; relations are {', '.join(RELATIONS)}")
    words = {word: name for name, words in RELATIONS.items() for word in words.split("|")}
    marker = "|".join(sorted(words, key=lambda w: -len(w)))
    first, *rest = re.split(rf"\b({marker})\b", plain)
    reader = _NounReader(labels, encoder)
    relations, rooms = list[tuple[str, NounPhrase]](), list[int | str]()
    for word, noun in zip(rest[::2], rest[1::2], strict=True):
        what = [w for w in noun.split() if w not in _FILLER]
        if not what:
            continue  # "where is the cup at"
        room = re.fullmatch(r"room (\d{1,9})", " ".join(what))
        kind = _KINDS.get("".join(what)) if words[word] == "in" else None
        if room or kind:
            rooms.append(int(room[1]) if room else kind or "")
        else:
            relations.append((words[word], reader.read(noun)))
    thing = reader.read(first)
    return Phrase(thing, tuple(relations), tuple(rooms), after_ns, before_ns)


class _NounReader:
    def __init__(self, labels: LabelSet, encoder: TextEncoder | None) -> None:
        self._labels, self._encoder = labels, encoder
        self._nouns = dict[str, dict[int, float]]()
        of_name = dict(zip(labels.names, labels.ids, strict=True))
        for words, names in SYNONYMS.items():
            there = [n for n in names.strip("+").split() if n in of_name] if names != "+" else list(of_name)
            there = there if names.startswith("+") else there[:1]
            for word in words.split():
                other = {n: OTHER_WEIGHT if n.startswith("other") and names != "+" else 1.0 for n in there}
                if there:
                    self._nouns.setdefault(_folded(word), {of_name[n]: weight for n, weight in other.items()})
        for name, number in of_name.items():
            for title in (name, PLAIN_NAMES.get(name, name)):
                self._nouns[_folded(re.sub(r"[\W_]", "", title.casefold()))] = {number: 1.0}

    def read(self, text: str) -> NounPhrase:
        colors, sizes, shade = list[str](), list[tuple[str, int]](), 0
        nouns, unknown = list[str](), list[str]()
        for word in self._words(text.split()):
            if word in _FILLER:
                continue
            if (color := COLOR_SYNONYMS.get(word, word)) in COLORS:
                colors.append(color)
            elif word in SHADES:
                shade = SHADES[word]
            elif word in SIZES:
                sizes.append(SIZES[word])
            elif self._encoder is not None or _folded(word) in self._nouns:
                nouns.append(word)
            else:
                unknown.append(word)
        if unknown:
            raise MapError(self._unknown(unknown[0]))
        if not nouns:
            raise MapError(f"find: '{text.strip()}' names no thing; 'thing' stands for any")
        looks = tuple(colors), shade, tuple(sizes)
        if self._encoder is not None and _folded(nouns[-1]) != "thing":
            return NounPhrase(text.strip(), class_weights(" ".join(nouns), self._labels, self._encoder), *looks)
        if len(nouns) > 1:
            raise MapError(
                f"find: '{nouns[0]}' and '{nouns[1]}' are two things; say how they lie: {', '.join(RELATIONS)}"
            )
        return NounPhrase(text.strip(), self._nouns[_folded(nouns[0])], *looks)

    def _words(self, words: list[str]) -> Iterator[str]:
        """Up to three words that are one known name are one."""
        k = 0
        while k < len(words):
            joined = ((n, "".join(words[k : k + n])) for n in (3, 2) if k + n <= len(words) and not self._encoder)
            count, word = next(((n, w) for n, w in joined if _folded(w) in self._nouns), (1, words[k]))
            yield word
            k += count

    def _unknown(self, word: str) -> str:
        relations = [w for words in RELATIONS.values() for w in words.split("|")]
        known = [*self._nouns, *COLORS, *COLOR_SYNONYMS, *SIZES, *SHADES, *_KINDS, *relations]
        near = difflib.get_close_matches(_folded(word), known, n=3, cutoff=0.6)
        hint = f"did you mean {' or '.join(near)}?" if near else f"things are {', '.join(self._labels.names)}"
        return f"find: '{word}' is not known; {hint}"


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
    units = {"minute": 60, "hour": 3600, "day": 86_400, "week": 604_800}
    while (found := _LAST.search(text)) or (found := _DATED.search(text)) or (found := _TODAY.search(text)):
        text = f"{text[: found.start()]} {text[found.end() :]}".strip()
        if found.re is _LAST:
            after = now_ns - int(found["n"] or 1) * units[found["unit"]] * 10**9
            continue
        start, end = _moment(found, now_ns)
        if found["when"] in ("before", "until"):
            before = start
        else:
            after = end if found["when"] == "after" else start
            before = end if found["when"] in (None, "on") and end > start else before
    return re.sub(r" +", " ", text), after, before


def has_date(stamp_ns: int) -> bool:
    """Whether a stamp counts from 1970, and not from the start of a device."""
    return stamp_ns >= _FIRST_DATE_NS


def _moment(found: re.Match[str], now_ns: int) -> tuple[int, int]:
    """First and last stamp of what is meant: a day, or a moment."""
    if not has_date(now_ns):
        raise MapError("find: the stamps of this map are no dates; ask 'in the last 10 minutes'")
    day = datetime.fromtimestamp(now_ns / 1e9).replace(hour=0, minute=0, second=0, microsecond=0)
    named, clock = found.groupdict().get("day"), found["clock"]
    try:
        if named and named[0].isdigit():
            day = datetime.fromisoformat(named)
        day -= timedelta(days=named == "yesterday")
        if clock is None:
            return _stamp(day), _stamp(day + timedelta(days=1))
        hour, _, minute = re.sub(r" ?[ap]m", "", {"noon": "12", "midnight": "0"}.get(clock, clock)).partition(":")
        late = 12 if clock.endswith("pm") and int(hour) < 12 else 0
        at = day.replace(hour=0 if clock.endswith("am") and hour == "12" else int(hour) + late, minute=int(minute or 0))
    except ValueError as error:
        raise MapError(f"find: '{found[0].strip()}' is no time: {error}") from error
    return _stamp(at), _stamp(at)


def _stamp(at: datetime) -> int:
    return round(at.timestamp()) * 10**9
