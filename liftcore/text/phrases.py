"""Grammar of typed phrases: what names things, and what is refused in words.

| phrase | as | read as |
|---|---|---|
| name | "the small red mug", "where is the mug?", "cup of tea", "mug with a lid" | the end of it that is a word |
| part | "the mug's handle", "handle of the mug"; "mug handle" if both are words | a part of an object |
| list | "mug, bowl", "mug and bowl", "mug or bowl" | several texts |
| negation | "bowl but not the mug", "bowl -mug", "not the mug but the bowl" | texts and negatives |
| quoted | '"first aid kit"' | what is in the quotes, as it is |

Places ("left of the mug", "the left mug"), actions ("man riding a horse"), numbers ("two mugs") and all but a thing
("not the mug", "everything except the mug") are refused: scores of texts answer none of them. An encoder of any text
also takes "in" and numbers, as in "tea in a glass": captions of photos have both.

A phrase that is itself a word of a table is that word, whatever is in it.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from typing import NamedTuple

from liftcore.errors import InvalidQuery

PUNCTUATION = " .,;:!?\"'\u2018\u2019\u201c\u201d()"
ARTICLES = frozenset({"a", "an", "the"})
IRREGULAR = {
    "mice": "mouse", "men": "man", "women": "woman", "children": "child", "feet": "foot", "teeth": "tooth",
    "geese": "goose", "oxen": "ox", "leaves": "leaf", "knives": "knife", "wolves": "wolf", "calves": "calf",
    "shelves": "shelf", "loaves": "loaf", "scarves": "scarf", "dice": "die", "cacti": "cactus",
}  # fmt: skip
_DETERMINERS = ARTICLES | frozenset({
    "my", "your", "his", "her", "its", "our", "their", "this", "that", "these", "those", "some",
})  # fmt: skip
# Nouns before "of" that do not name the object, as in "a piece of pizza".
_PARTITIVES = frozenset({
    "photo", "photos", "photograph", "picture", "pictures", "image", "images", "piece", "pieces", "slice", "slices",
    "pair", "pairs", "kind", "sort", "type", "group", "bit", "bits", "set", "model", "lot", "lots", "couple", "one",
    "some", "all",
})  # fmt: skip
# At the end of a question.
_TRAILING = frozenset({"here", "there", "please", "now", "too", "thanks", "is", "are", "only", "alone"})
_OPENING = re.compile(
    r"(please|hey|hi|hello|ok|and|or|where|what|which|how|who|is|are|was|there|do|does|you|see|can|could|would|will|i|"
    r"i'm|we|me|us|want|need|like|to|find|show|give|get|select|highlight|segment|mark|pick|detect|locate|search|look|"
    r"looking|for|all|every|each|any|only|just|both(?=.*\sand\s)|either)\s+"
)
_PLACES = re.compile(
    r"(?:^|\s)(?:(?:to|on|at|in) the (?:left|right|front|back|top|bottom|side|middle)(?: side)?(?: of)?|"
    r"(?:left|right|front) of|(?:in|at the) front of|on top of|next to|close to|far from|away from|on|in|at|"
    r"under|underneath|beneath|below|above|over|near|nearest|nearby|by|beside|besides|behind|inside|outside|within|"
    r"between|among|amid|against|around|across|along|atop|opposite|upon|onto|into|through|beyond|off|facing|"
    r"touching)(?=\s|$)"
)
_SIDES = frozenset({
    "left", "right", "leftmost", "rightmost", "nearest", "closest", "furthest", "farthest", "topmost", "other",
    "first", "second", "third", "last", "biggest", "largest", "smallest", "tallest", "lowest", "highest", "same",
})  # fmt: skip
_NUMBERS = frozenset({
    "two", "three", "four", "five", "six", "seven", "eight", "nine", "ten", "eleven", "twelve", "both", "several",
    "many", "few", "no.", "half",
})  # fmt: skip
_NEGATION = re.compile(
    r"(?:^|[\s,;(]+)(?:[-!](?=[^\W\d]|[\"\u201c])|(?:but not|and not|or not|rather than|instead of|other than|"
    r"apart from|aside from|except for|except|excluding|exclude|remove|hide|delete|ignore|without|w/o|minus|but|not|"
    r"no|non|never|neither|nor|isn't|aren't|don't)(?=\s|$))"
)
_QUOTATION = re.compile(r"""["\u201c]\s*([^\s"\u201c\u201d][^"\u201c\u201d]*)["\u201d]""")  # of a whole text
_ALTERNATIVES = frozenset({"but", "rather than", "instead of"})
_UNIVERSALS = frozenset({
    "", "it", "everything", "anything", "something", "nothing", "all", "any", "every", "things", "thing", "objects",
    "stuff", "rest", "whatever", "scene", "none",
})  # fmt: skip
_RELATIVE = re.compile(r"(?:\s+(?:that|which|who|is|are|has|have|but|and|,))+$")
_COMMAS = re.compile(r"\s*[,;|\u00b7\u2022]\s*|(?:^|\s)\d+[.)]\s|\s+[-/&+]\s+|(?<=[a-z]{3})/(?=[a-z]{3})")
_CONJUNCTIONS = re.compile(r"\s+(?:and|or|and/or|vs\.?|plus|as well as|along with|together with)\s+")
_QUALIFIER = re.compile(r"\s(?:with|from|for|that|which|who|made|is|are|has|having|to)(?=\s|$)")
# Adjectives that "and" joins before a noun, as in "a black and white mug".
_COLOURS = frozenset({
    "black", "white", "red", "green", "blue", "yellow", "orange", "brown", "grey", "gray", "pink", "purple", "gold",
    "silver", "big", "small", "large", "little", "old", "new", "round", "long", "short", "dark", "bright", "shiny",
})  # fmt: skip
_HEAD_WORDS = 12  # last words of a phrase that are searched for its head


class Reading(NamedTuple):
    """The texts that a phrase names, and those that it excludes."""

    names: tuple[str, ...]
    negatives: tuple[str, ...]
    is_quoted: bool = False  # True for a name that was in quotes, which is read as it is


class PartPhrase(NamedTuple):
    """A phrase that names a part of an object."""

    object_phrase: str
    part: str
    sure: bool  # True if the grammar is unambiguous; two nouns in a row, as in "mug handle", may mean something else

    def __str__(self) -> str:
        return f"{self.part} of the {self.object_phrase}"


def read_phrase(text: str, is_word: Callable[[str], bool] | None) -> Reading:
    """Read a typed phrase as names and negatives.

    Args:
        is_word: whether a table has a word for a text as a whole; None for an encoder that reads any text.
    """
    if quotation := _QUOTATION.fullmatch(text.strip()):
        return Reading((quotation[1].rstrip(),), (), is_quoted=True)
    is_name = is_word or (lambda _: False)
    typed = _tidy(text)
    if is_name(typed):
        return Reading((text,), ())
    typed = _without_opening(typed, is_name)
    negation = _NEGATION.search(typed)
    if negation is None:
        names = _list(typed, is_name)
        _check(text, names or [typed], is_word)
        return Reading((text,) if names in ([], [typed]) else tuple(names), ())
    before, after = _RELATIVE.sub("", typed[: negation.start()]), typed[negation.end() :]
    names, negatives = _list(before, is_name), _list(after, is_name)
    alternative = _NEGATION.search(after)
    if before.strip() in _UNIVERSALS and alternative and alternative.group().strip(" ,;") in _ALTERNATIVES:
        names, negatives = _list(after[alternative.end() :], is_name), _list(after[: alternative.start()], is_name)
    elif alternative:  # "neither mug nor bowl", "bowl, not mug, not lamp"
        negatives = [name for piece in _NEGATION.split(after) for name in _list(piece, is_name)]
    names = [name for name in names if _without_articles(name) not in _UNIVERSALS]
    if not names or not negatives or not set(names).isdisjoint(negatives):
        raise InvalidQuery(
            "text", expected="what to look for, and then what it is not", got=repr(text[:80]),
            hint="scores find what is like a word: ask for the things that you want, such as 'bowl but not the mug', "
            "or take the selection of the word away from all splats",
        )  # fmt: skip
    _check(text, names + negatives, is_word)
    return Reading(tuple(names), tuple(negatives))


def _check(text: str, names: list[str], is_word: Callable[[str], bool] | None) -> None:
    """Refuse names with a place, an action or a number."""
    for name in names:
        if is_word is not None and is_word(name):
            continue
        words, place = _without_articles(name).split(), _PLACES.search(name)
        if place and is_word is None and place.group().strip() == "in" and place.start():
            place = None
        subject = name[: place.start()] if place else _before_action(name, is_word)
        if place or subject:
            subject = _without_articles(re.sub(r"\s\w+(?:ing|ed)$", "", subject))
            _refuse("places and actions", text, subject, is_word)
        if len(words) > 1 and words[0] in _SIDES and words[1] != "of":
            _refuse("places and comparisons", text, " ".join(words[1:]), is_word)
        if len(words) > 1 and is_word is not None and (words[0] in _NUMBERS or words[0].isdecimal()):
            _refuse("numbers", text, " ".join(words[1:]), is_word)


def _refuse(subject: str, text: str, rest: str, is_word: Callable[[str], bool] | None) -> None:
    expected = f"a name, a part, a list or a negation: {subject} are not understood"
    hint = f"ask for {rest!r}" if rest not in _DETERMINERS | _UNIVERSALS else "ask for the thing by its name"
    if is_word is None:
        hint += "; or put all of the text in double quotes, to ask for it as it is"
    raise InvalidQuery("text", expected=expected, got=repr(text[:80]), hint=hint)


def _before_action(name: str, is_word: Callable[[str], bool] | None) -> str:
    """Return what comes before a verb, as "man" of "man riding a horse"; empty if there is no verb."""
    words = name.split()
    for index in range(1, len(words) - 1):
        if words[index].endswith("ing") and words[index - 1] not in _DETERMINERS | {"of"}:
            before = _without_articles(" ".join(words[:index]))
            if words[index + 1] in _DETERMINERS or (is_word is not None and is_word(before)):
                return before
    return ""


def _tidy(text: str) -> str:
    lines = ", ".join(line.strip("-*\u2022 ") for line in re.split(r"[\n\r\t]", text.strip()))
    typed = " ".join(lines.casefold().replace("_", " ").replace("\u2019", "'").split())
    return typed.strip(PUNCTUATION.replace("'", ""))


def _without_opening(typed: str, is_name: Callable[[str], bool]) -> str:
    """Return a phrase without the polite words or the question before and after it."""
    while (opening := _OPENING.match(typed)) and not is_name(typed):
        typed = typed[opening.end() :]
    words = typed.split()
    while len(words) > 1 and words[-1].strip(PUNCTUATION) in _TRAILING:
        words.pop()
    return " ".join(words)


def _without_articles(name: str) -> str:
    words = name.split()
    while len(words) > 1 and words[0] in _DETERMINERS:
        words.pop(0)
    return " ".join(words)


def _list(typed: str, is_name: Callable[[str], bool]) -> list[str]:
    """Return the items of a list."""
    items = list[str]()
    for between_commas in _COMMAS.split(f"{typed} "):
        piece = re.sub(r"^(?:and|or)\s+", "", between_commas.strip(PUNCTUATION))
        names = [piece] if is_name(piece) else _CONJUNCTIONS.split(piece)
        is_coloured = len(names[-1].split()) > 1 and all(_without_articles(name) in _COLOURS for name in names[:-1])
        items.extend([piece] if is_coloured else names)
    items = [_without_opening(item.strip(PUNCTUATION), is_name) for item in items]
    return list(dict.fromkeys(item for item in items if item and item not in _TRAILING))


def part_phrases(text: str) -> Iterator[PartPhrase]:
    """Yield the ways to parse a text as a part of an object, the most likely first.

    "The cat's tail" and "tail of the cat" name a part. "A cup of coffee", without an article after "of", does not,
    nor does a partitive, "a photo of a cat". "Handles of mugs" is uncertain, as "bowls of oranges" names no part; so
    are plural owners without an article, as "men's shoes" are a kind of shoe.
    """
    typed = text.casefold().replace("_", " ").split()
    is_certain = bool(typed) and typed[0].strip(PUNCTUATION) in _DETERMINERS
    typed = typed[1:] if typed and typed[0].strip(PUNCTUATION) in ARTICLES else typed
    parts = [part.strip(PUNCTUATION) for part in typed]
    if len(parts) > _HEAD_WORDS:
        return
    for index, part in enumerate(parts[:-1]):
        owner = part[:-2] if part.endswith(("'s", "\u2019s")) else part
        if owner != part or (typed[index].endswith(("s'", "s\u2019")) and typed[index][0] not in PUNCTUATION):
            is_one = owner != part and owner not in IRREGULAR
            owners, piece = " ".join([*parts[:index], owner]), " ".join(parts[index + 1 :])
            yield PartPhrase(owners, piece, is_certain or is_one)
        if part == "of" and index and parts[index - 1] not in _PARTITIVES:
            of = parts[index + 1 :]
            if of[0] in _DETERMINERS and len(of) > 1:
                yield PartPhrase(" ".join(of[1:]), " ".join(parts[:index]), True)
            elif of[-1] in IRREGULAR or (len(of[-1]) > 2 and of[-1].endswith("s") and not of[-1].endswith("ss")):
                yield PartPhrase(" ".join(of), " ".join(parts[:index]), False)
    if len(parts) > 1 and "of" not in parts and not _QUALIFIER.search(f" {' '.join(parts)}"):
        for index in range(len(parts) - 1, 0, -1):
            yield PartPhrase(" ".join(parts[:index]), " ".join(parts[index:]), False)


def heads(text: str) -> Iterator[str]:
    """Yield the ends of a name that may be the noun without its adjectives, the longest first."""
    name = _without_opening(_tidy(text), lambda _: False)
    name = name[: qualifier.start()] if (qualifier := _QUALIFIER.search(name)) else name
    left, _, right = name.partition(" of ")
    owner = next((word.removesuffix("'s") for word in name.split() if word.endswith("'s")), "")
    sides = [right if right and left.split()[-1] in _PARTITIVES else left]
    if right.split(" ")[0] in _DETERMINERS:  # the object of a part that may have no word
        sides.append(right)
    for side in sides:
        words = [word.strip(PUNCTUATION) for word in side.split()]
        while len(words) > 1 and words[-1] in _PARTITIVES:
            words.pop()
        for first in range(max(0, len(words) - _HEAD_WORDS), len(words)):
            yield " ".join(words[first:])
    yield from filter(None, [owner])
