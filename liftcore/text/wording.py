"""Words as people type them, mapped to words that a table has.

A table knows its own words alone, and people type others: plurals, synonyms, phrases, and words that mean nothing to
it. `Vocabulary.find` tries in this order, and says which of them it was:

1. the word itself; cases, articles, ``_``, spaces and hyphens make no difference;
2. the same without its qualifier, "car" for "car (automobile)";
3. a synonym (``synonyms.json``: of LVIS, and everyday ones);
4. these of the singular, or of the plural;
5. the head of a phrase, "the red cup" as "cup", "a photo of two cows" as "cow".

`Vocabulary.find_part` reads a phrase as a part within a thing, "the red mug's handle", "mug handle".

A word that is there is never replaced by another. What none of this finds is refused, with the nearest words.
"""

from __future__ import annotations

import json
import re
import unicodedata
from collections.abc import Iterable, Iterator, Sequence
from difflib import get_close_matches
from functools import cache, cached_property
from itertools import chain, islice
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

if TYPE_CHECKING:
    import numpy as np

SYNONYMS = Path(__file__).with_name("synonyms.json")
SUGGESTED = 5  # words named where one is not known
_ARTICLES = frozenset({"a", "an", "the"})
_OWNERS = frozenset({"my", "your", "his", "her", "its", "our", "their", "this", "that"})
_AROUND = " .,;:!?\"'\u2018\u2019\u201c\u201d()"
_QUALIFIER = re.compile(r"\s*\([^)]*\).*$")
_BETWEEN = re.compile(r"[\s\-'\u2019.]+")
_LAST = frozenset({"here", "there", "please", "now", "too"})  # words behind a question
_BEHIND = frozenset({
    "on", "in", "with", "at", "under", "near", "by", "beside", "behind", "from", "for", "that", "which", "who", "to",
    "made", "is", "are", "and", "or", "without", "over", "inside", "next", "above", "below", "beneath", "underneath",
    "between", "among", "against", "around", "across", "along", "atop", "opposite", "close", "outside", "upon",
})  # fmt: skip
_PLACED = ("ing", "ed", "left", "right")  # ends of what stands between a thing and where it is, as in "sitting on"
# What is said of another thing, as in "a piece of pizza".
_PARTS = frozenset({
    "photo", "photos", "photograph", "picture", "pictures", "image", "images", "piece", "pieces", "slice", "slices",
    "pair", "pairs", "kind", "sort", "type", "group", "bit", "bits", "set", "model", "lot", "lots", "couple", "one",
    "some", "all",
})  # fmt: skip
_IRREGULAR = {
    "mice": "mouse", "men": "man", "women": "woman", "children": "child", "feet": "foot", "teeth": "tooth",
    "geese": "goose", "oxen": "ox", "leaves": "leaf", "knives": "knife", "wolves": "wolf", "calves": "calf",
    "shelves": "shelf", "loaves": "loaf", "scarves": "scarf", "dice": "die", "cacti": "cactus",
}  # fmt: skip
_HEAD_WORDS = 12  # of a phrase that are looked at, the last ones
_TYPED_LEAST = 3  # characters of a text, below which letters say nothing
_SYNONYM_LEAST = 5  # the same of a synonym: there are thousands
_TYPED = 80  # characters of a text that are compared by letters
_COMPARED = 3000  # words that are compared by letters: a long list would hold up other questions
_TYPO = 0.8  # likeness of letters from which a word is likely to be meant
_BEGUN = 0.8  # the same, of the beginning of a word
_MEANT = 0.35  # cosine about the mean of the shipped words from which two words mean something near


class Wording(NamedTuple):
    """A text, and the word that stands for it."""

    text: str
    word: str
    how: str  # "" for the word itself, else "spelling", "qualifier", "synonym", "number", "head" or "part"


class PartPhrase(NamedTuple):
    """A phrase that names a part of a thing."""

    thing: str
    part: str
    sure: bool  # it says so by its grammar; two nouns in a row, as in "mug handle", may mean something else

    def __str__(self) -> str:
        return f"{self.part} of the {self.thing}"


def part_phrases(text: str) -> Iterator[PartPhrase]:
    """The ways to read a text as a part of a thing, the likeliest first.

    "The cat's tail" and "tail of the cat" say so. Of "a cup of coffee", where no article follows, nothing is a part
    of the other; nor of what is said of a thing, as "a photo of a cat". "Handles of mugs" may be either, as "bowls of
    oranges" shows, and so may several owners without an article: "men's shoes" are a kind of shoes.
    """
    typed = text.casefold().replace("_", " ").split()
    is_certain = bool(typed) and typed[0].strip(_AROUND) in _ARTICLES | _OWNERS
    typed = typed[1:] if typed and typed[0].strip(_AROUND) in _ARTICLES else typed
    parts = [part.strip(_AROUND) for part in typed]
    if len(parts) > _HEAD_WORDS:
        return
    for place, part in enumerate(parts[:-1]):
        owner = part[:-2] if part.endswith(("'s", "\u2019s")) else part
        if owner != part or (typed[place].endswith(("s'", "s\u2019")) and typed[place][0] not in _AROUND):
            is_one = owner != part and owner not in _IRREGULAR
            owners, piece = " ".join([*parts[:place], owner]), " ".join(parts[place + 1 :])
            yield PartPhrase(owners, piece, is_certain or is_one)
        if part == "of" and place and parts[place - 1] not in _PARTS:
            of = parts[place + 1 :]
            if of[0] in _ARTICLES | _OWNERS and len(of) > 1:
                yield PartPhrase(" ".join(of[1:]), " ".join(parts[:place]), True)
            elif of[-1] in _IRREGULAR or (len(of[-1]) > 2 and of[-1].endswith("s") and not of[-1].endswith("ss")):
                yield PartPhrase(" ".join(of), " ".join(parts[:place]), False)
    if len(parts) > 1 and not any(part in _BEHIND | {"of"} for part in parts):
        for place in range(len(parts) - 1, 0, -1):
            yield PartPhrase(" ".join(parts[:place]), " ".join(parts[place:]), False)


class Completion(NamedTuple):
    """A word that can be asked, for what was typed of it."""

    word: str
    typed: str  # what begins as the text does: the word, or a synonym of it


def plain(text: str) -> str:
    """The text as tables compare it, in Unicode's composed form.

    Cases, ``_`` for a space and a leading article make no difference.
    """
    parts = unicodedata.normalize("NFC", text.casefold()).replace("_", " ").split()
    return " ".join(parts[1:] if len(parts) > 1 and parts[0] in _ARTICLES else parts)


def _key(text: str) -> str:
    return _BETWEEN.sub("", plain(text).strip(_AROUND)) or plain(text)


def base_of(word: str) -> str:
    """The word without its qualifier."""
    return _QUALIFIER.sub("", word) or word


class Vocabulary:
    """The words of a table, as people may type them.

    Args:
        words: n; of equal ones the first counts, and ``_`` is a space.
    """

    def __init__(self, words: Sequence[str]) -> None:
        self.words = tuple(dict.fromkeys(word.replace("_", " ") for word in words))
        self._exact = {plain(word): word for word in reversed(self.words)}

    @cached_property
    def _keys(self) -> dict[str, str]:
        return {_key(word): word for word in reversed(self.words)}

    @cached_property
    def _bases(self) -> dict[str, str]:
        # Of several meanings an animal comes before the others, and food after them.
        order = sorted(self.words, key=lambda word: ("(food)" in word) - ("(animal)" in word))
        return {_key(base_of(word)): word for word in reversed(order)}

    @cached_property
    def _parted(self) -> list[tuple[str, list[str]]]:
        parted = ((word, plain(base_of(word)).split()) for word in self.words)
        return [(word, parts) for word, parts in parted if len(parts) > 1]

    def __contains__(self, text: str) -> bool:
        """Whether a text is one of the words itself."""
        return plain(text) in self._exact

    def find(self, text: str) -> Wording | None:
        """The word that stands for a text; None where there is none."""
        if text in self:
            return Wording(text, self._exact[plain(text)], "")
        whole = self._look_up(text)
        if whole is not None:
            return Wording(text, *whole)
        head = self._head(text)
        return None if head is None else Wording(text, head[1], "head")

    def find_part(self, text: str) -> PartPhrase | None:
        """The words of a part and its thing, where a text names both and is no word as a whole; None else.

        Adjectives are left out, as in the heads of other phrases. Of "red toy car" nothing is a part of another where
        "toy car" is a word.
        """
        if self.word_of(text) is not None:
            return None
        for phrase in part_phrases(text):
            thing = self.find(phrase.thing)
            part = self.find(phrase.part)
            if thing is None or part is None:
                continue
            head = None if thing.how != "head" or " of " in text else self._head(text)
            if phrase.sure or (part.how != "head" and (head is None or head[0] == phrase.part)):
                return PartPhrase(thing.word, part.word, phrase.sure)
        return None

    def unknown_part(self, text: str) -> PartPhrase | None:
        """A part as it was typed, and the word of its thing, where a text names a part that is no word; None else."""
        if self.word_of(text) is not None:
            return None
        for phrase in part_phrases(text):
            thing = self.find(phrase.thing) if phrase.sure else None
            if thing is not None and self.find(phrase.part) is None:
                return PartPhrase(thing.word, phrase.part, True)
        return None

    def _head(self, text: str) -> tuple[str, str] | None:
        """The longest part of a phrase that a word stands for, and this word."""
        for head in islice(_heads(text), 4 * _HEAD_WORDS):
            if (found := self._look_up(head)) is not None:
                return head, found[0]
        return None

    def word_of(self, text: str) -> str | None:
        """The word that stands for a text as a whole, and not for its head alone."""
        if text in self:
            return self._exact[plain(text)]
        found = self._look_up(text)
        return None if found is None else found[0]

    def _look_up(self, text: str) -> tuple[str, str] | None:
        """A word for a text as a whole, and how it was found."""
        for form in _forms(text):
            same = form == plain(text).strip(_AROUND)
            key = _key(form)
            if key in self._keys:
                return self._keys[key], "spelling" if same else "number"
            if key in self._bases:
                return self._bases[key], "qualifier" if same else "number"
            for other in _synonyms().get(key, ()):
                word = self._keys.get(_key(other)) or self._bases.get(_key(base_of(other)))
                if word is not None:
                    return word, "synonym"
        return None

    def nearest(self, text: str, count: int = SUGGESTED, first: Iterable[str] = ()) -> tuple[str, ...]:
        """Words to ask for in place of one that is not known, the likeliest first; none where none is near.

        Args:
            first: words that come before others of their kind, such as those of the scene.
        """
        meant, preferred = self.find(text), set(first)
        found = dict.fromkeys([meant.word] if meant else [])
        if not any(self._of_group(text)):  # else it is no misspelt word
            found.update(dict.fromkeys(self._misspelt(text)))
        for head in chain([text], islice(_heads(text), _HEAD_WORDS)):
            of_kind = sorted(self._of_group(head), key=lambda word: word not in preferred)
            found.update(dict.fromkeys([*of_kind, *self._of_meaning(head), *self._with_token(head)]))
            if len(found) >= count:
                break
        return tuple(found)[:count]

    def complete(self, text: str, count: int = 8) -> tuple[Completion, ...]:
        """Words that begin as a text does, then those of which a part does, synonyms, and what has like letters."""
        start = plain(text).strip(_AROUND)
        if not start:
            return ()
        some: dict[str, Completion] = {}

        def take(words: Iterable[tuple[str, str]]) -> None:
            for word, typed in words:
                if len(some) >= count:
                    return
                some.setdefault(word, Completion(word, typed))

        listed = [(word, plain(word)) for word in self.words]
        begin = [(word, known) for word, known in listed if known.startswith(start)]
        take((word, word) for word, _ in sorted(begin, key=lambda pair: len(pair[1])))
        take((word, word) for word, known in listed if any(part.startswith(start) for part in known.split()))
        for typed, others in _typed_synonyms().items():
            if typed.startswith(start):
                for other in others:
                    word = self._keys.get(_key(other)) or self._bases.get(_key(base_of(other)))
                    take([(word, typed)] if word else [])
        found = self.find(text)
        take([(found.word, found.word)] if found else [])
        take((word, word) for word in self._misspelt(text))
        if len(start) >= _TYPED_LEAST:
            begun = {known[: len(start)]: word for word, known in reversed(listed[:_COMPARED])}
            take((begun[known], begun[known]) for known in get_close_matches(start, begun, n=3, cutoff=_BEGUN))
        return tuple(some.values())

    def _misspelt(self, text: str) -> list[str]:
        """Words of the same first letter and nearly the same others."""
        typed = plain(text).strip(_AROUND)[:_TYPED]
        if len(typed) < _TYPED_LEAST:
            return []
        known = {plain(base_of(word))[:_TYPED]: word for word in reversed(self.words[:_COMPARED])}
        known = {name: word for name, word in known.items() if name.startswith(typed[0])}
        alike = get_close_matches(typed, known, n=3, cutoff=_TYPO)
        if not alike:
            synonyms = [one for one in _typed_synonyms() if len(one) >= _SYNONYM_LEAST and one[0] == typed[0]]
            some = get_close_matches(typed, synonyms, n=1, cutoff=_TYPO) if len(typed) >= _SYNONYM_LEAST else []
            for name in some:
                found = self._look_up(name)
                alike = [] if found is None else [found[0]]
            return alike
        return [known[name] for name in alike]

    def _of_group(self, text: str) -> Iterator[str]:
        """Words of the kinds that a text names or belongs to."""
        forms = {_key(form) for form in _forms(text)}
        for group, members in _table()["groups"].items():
            if _key(group) in forms or any(_key(member) in forms for member in members):
                for member in (group, *members):
                    found = self._keys.get(_key(member)) or self._bases.get(_key(base_of(member)))
                    if found is not None and _key(found) not in forms:
                        yield found

    def _of_meaning(self, text: str) -> list[str]:
        """Words whose vectors are near to that of a shipped word which stands for the text."""
        import numpy as np

        shipped, rows = _shipped()
        meant = shipped.word_of(text)
        if meant is None or len(self.words) > _COMPARED:
            return []
        place = {known: row for row, known in enumerate(shipped.words)}
        own = [(word, known) for word in self.words if (known := shipped.word_of(word))]
        if not own:
            return []
        near = rows[[place[known] for _, known in own]] @ rows[place[meant]]
        order = np.argsort(-near, kind="stable")[: SUGGESTED + 1]
        return [own[row][0] for row in order.tolist() if near[row] >= _MEANT]

    def _with_token(self, text: str) -> list[str]:
        """Words of several parts, one of which is the text; those that end with it come first."""
        forms = {form for form in _forms(text) if form}
        ends = [word for word, parts in self._parted if parts[-1] in forms]
        return ends + [word for word, parts in self._parted if not forms.isdisjoint(parts[:-1])]


def _forms(text: str) -> Iterator[str]:
    """A text as it is, and with its last word in the singular or the plural."""
    whole = plain(text).strip(_AROUND)
    yield whole
    before, _, last = whole.rpartition(" ")
    for form in _numbers(last):
        yield f"{before} {form}".strip()


def _numbers(word: str) -> Iterator[str]:
    if word in _IRREGULAR:
        yield _IRREGULAR[word]
    if len(word) > 3 and word.endswith("ies"):
        yield f"{word[:-3]}y"
    if len(word) > 3 and word.endswith(("ses", "xes", "zes", "ches", "shes", "oes")):
        yield word[:-2]
    if len(word) > 2 and word.endswith("s") and not word.endswith("ss"):
        yield word[:-1]
    if word.endswith("y"):
        yield f"{word[:-1]}ies"
    if word and not word.endswith("s"):
        yield f"{word}s"
        yield f"{word}es"


def _heads(text: str) -> Iterator[str]:
    """Parts of a phrase that may name its thing, the likeliest first."""
    parts = [part.strip(_AROUND) for part in plain(text).split()]
    while parts and (parts[-1] in _LAST or (len(parts) > 1 and parts[-1] in _PARTS)):
        parts.pop()
    # A question's own words come before its thing: of "where is the cat" the last words are tried alone.
    behind = next((place for place, part in enumerate(parts) if part in _BEHIND and place > 0), len(parts))
    for some in (parts[:behind], parts[behind + 1 :]):
        of = [place for place, part in enumerate(some) if part == "of" and 0 < place < len(some) - 1]
        left, right = (some[: of[0]], some[of[0] + 1 :]) if of else (some, [])
        sides = (right, left) if of and left[-1] in _PARTS else (left, right)
        if len(left) > 1 and left[-1].endswith(_PLACED) and (of or behind < len(parts)):
            sides = (left, left[:-1], right)
        for side in sides:
            for first in range(max(0, len(side) - _HEAD_WORDS), len(side)):
                yield " ".join(side[first:])
    for part in parts:
        for mark in ("'s", "\u2019s"):
            if part.endswith(mark):
                yield part.removesuffix(mark)


@cache
def _table() -> dict[str, dict[str, Any]]:
    return json.loads(SYNONYMS.read_text("utf-8"))


@cache
def _typed_synonyms() -> dict[str, list[str]]:
    """Each synonym without its qualifier, in plain letters, and the words that it stands for."""
    found: dict[str, list[str]] = {}
    for name in ("lvis", "everyday"):
        for word, synonyms in _table()[name].items():
            for synonym in synonyms:
                for form in {plain(synonym), plain(base_of(synonym))}:
                    found.setdefault(form, []).append(word)
    return found


@cache
def _synonyms() -> dict[str, list[str]]:
    """By the key of a word or a synonym: what it stands for, then what stands for it."""
    found: dict[str, list[str]] = {}
    for typed, words in _typed_synonyms().items():
        found.setdefault(_key(typed), []).extend(words)
    for name in ("lvis", "everyday"):
        for word, synonyms in _table()[name].items():
            for form in {_key(word), _key(base_of(word))}:
                found.setdefault(form, []).extend(synonyms)
    return found


def shipped_words() -> Vocabulary:
    """The words of the table that ships."""
    return _shipped()[0]


@cache
def _shipped() -> tuple[Vocabulary, np.ndarray]:
    """The shipped words, and [n, F] f32 what each means apart from what all words share, unit."""
    import numpy as np

    from liftcore.text import LVIS_TABLE
    from liftcore.text.table import TableEncoder

    table = TableEncoder.open(LVIS_TABLE)
    about = table.embeddings - table.embeddings.mean(axis=0)
    return Vocabulary(table.words), about / np.linalg.norm(about, axis=1, keepdims=True)
