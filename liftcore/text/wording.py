"""Matches of typed text with the words of a table.

A table has only its own words, and users type others: plurals, synonyms, phrases and unknown words.
`Vocabulary.find` tries these in order, and returns the kind of the match too:

1. the word itself, without regard to case, articles, ``_``, spaces and hyphens;
2. the word without its qualifier, "car" for "car (automobile)";
3. a synonym (``synonyms.json``: those of LVIS, and everyday ones);
4. the same for the singular or the plural;
5. the head of a name (`liftcore.text.phrases`), "cup" for "the red cup".

`Vocabulary.find_part` parses a phrase as a part of an object, "the red mug's handle", "mug handle".

A word of the table is never replaced by another. A text without a match is an error that suggests the nearest words.
"""

from __future__ import annotations

import json
import re
import unicodedata
from collections.abc import Iterable, Iterator, Sequence
from difflib import get_close_matches
from functools import cache, cached_property
from itertools import chain
from pathlib import Path
from typing import Any, NamedTuple

from liftcore.errors import InvalidQuery
from liftcore.text.phrases import (
    ARTICLES,
    IRREGULAR,
    PUNCTUATION,
    PartPhrase,
    Reading,
    heads,
    part_phrases,
    read_phrase,
)

SYNONYMS = Path(__file__).with_name("synonyms.json")
SUGGESTED = 5  # words suggested for an unknown one
_QUALIFIER = re.compile(r"\s*\([^)]*\).*$")
_SEPARATORS = re.compile(r"[\s\-'\u2019.]+")
_MIN_TYPED = 3  # characters of a text whose spelling is compared: shorter ones resemble too many words
_MIN_SYNONYM = 5  # the same for a synonym, of which there are thousands
_MAX_TYPED = 80  # characters of a text that are compared
_MAX_COMPARED = 3000  # words whose spelling is compared: a longer list would delay other queries
_TYPO_SIMILARITY = 0.8  # least similarity of spelling of a misspelt word, of difflib
_PREFIX_SIMILARITY = 0.8  # the same for the beginning of a word


class Wording(NamedTuple):
    """A text and the word that matches it."""

    text: str
    word: str
    match: str  # "" for the word itself, else one of `liftcore.query.question.WordMatch`


class Completion(NamedTuple):
    """A word that completes a typed text."""

    word: str
    typed: str  # the word, or the synonym of it, that begins with the text


def normalize_text(text: str) -> str:
    """Return a text as tables compare it, in Unicode's composed form (NFC).

    It is case-folded, has a space for each ``_``, and no leading article.
    """
    parts = unicodedata.normalize("NFC", text.casefold()).replace("_", " ").split()
    return " ".join(parts[1:] if len(parts) > 1 and parts[0] in ARTICLES else parts)


def _spelling_key(text: str) -> str:
    return _SEPARATORS.sub("", normalize_text(text).strip(PUNCTUATION)) or normalize_text(text)


def base_of(word: str) -> str:
    """Return the word without its qualifier."""
    return _QUALIFIER.sub("", word) or word


class Vocabulary:
    """Words of a table, found by typed text.

    Args:
        words: n words; of equal ones the first counts, and ``_`` is a space.
    """

    def __init__(self, words: Sequence[str]) -> None:
        self.words = tuple(dict.fromkeys(word.replace("_", " ") for word in words))
        self._exact = {normalize_text(word): word for word in reversed(self.words)}

    @cached_property
    def _keys(self) -> dict[str, str]:
        return {_spelling_key(word): word for word in reversed(self.words)}

    @cached_property
    def _bases(self) -> dict[str, str]:
        # Of words that differ by qualifier alone, an animal comes first and food last.
        order = sorted(self.words, key=lambda word: ("(food)" in word) - ("(animal)" in word))
        return {_spelling_key(base_of(word)): word for word in reversed(order)}

    @cached_property
    def _multi_word(self) -> list[tuple[str, list[str]]]:
        split_words = ((word, normalize_text(base_of(word)).split()) for word in self.words)
        return [(word, parts) for word, parts in split_words if len(parts) > 1]

    def __contains__(self, text: str) -> bool:
        """Return True if a text is itself one of the words."""
        return normalize_text(text) in self._exact

    def find(self, text: str) -> Wording | None:
        """Return the word that matches a text, None if there is no match."""
        if text in self:
            return Wording(text, self._exact[normalize_text(text)], "")
        match = self._look_up(text)
        if match is not None:
            return Wording(text, *match)
        try:
            reading = read_phrase(text, self.has_word)
        except InvalidQuery:
            return None
        if reading != Reading((text,), ()):
            return None
        head = self._head(text)
        return None if head is None else Wording(text, head[1], "head")

    def has_word(self, text: str) -> bool:
        """Return True if a word matches a text as a whole."""
        return text in self or self._look_up(text) is not None

    def find_part(self, text: str) -> PartPhrase | None:
        """Return the words of a part and its object if a text names both and is not itself a word, else None.

        Adjectives are ignored, as in the heads of other phrases. "Red toy car" names no part if "toy car" is a word.
        """
        if self.has_word(text):
            return None
        for phrase in part_phrases(text):
            object_match = self.find(phrase.object_phrase)
            part_match = self.find(phrase.part)
            if object_match is None or part_match is None:
                continue
            head = None if object_match.match != "head" or " of " in text else self._head(text)
            if phrase.sure or (part_match.match != "head" and (head is None or head[0] == phrase.part)):
                return PartPhrase(object_match.word, part_match.word, phrase.sure)
        return None

    def unknown_part(self, text: str) -> PartPhrase | None:
        """Return a part as typed and the word of its object if no word matches the part, else None."""
        if self.has_word(text):
            return None
        for phrase in part_phrases(text):
            object_match = self.find(phrase.object_phrase) if phrase.sure else None
            if object_match is not None and self.find(phrase.part) is None:
                return PartPhrase(object_match.word, phrase.part, True)
        return None

    def _head(self, text: str) -> tuple[str, str] | None:
        """Return the longest head of a phrase that matches a word, and this word."""
        for head in heads(text):
            if (match := self._look_up(head)) is not None:
                return head, match[0]
        return None

    def _look_up(self, text: str) -> tuple[str, str] | None:
        """Return the word that matches a text as a whole, and the kind of match."""
        for form in _forms(text):
            is_unchanged = form == normalize_text(text).strip(PUNCTUATION)
            key = _spelling_key(form)
            if key in self._keys:
                return self._keys[key], "spelling" if is_unchanged else "number"
            if key in self._bases:
                return self._bases[key], "qualifier" if is_unchanged else "number"
            for synonym in _synonyms().get(key, ()):
                word = self._word_or_base(synonym)
                if word is not None:
                    return word, "synonym"
        return None

    def nearest(self, text: str, count: int = SUGGESTED, first: Iterable[str] = ()) -> tuple[str, ...]:
        """Return words to suggest for an unknown one, the most likely first; empty if none is near.

        Args:
            first: words that come before others of their kind, such as those of the scene.
        """
        match, preferred = self.find(text), set(first)
        words = dict.fromkeys([match.word] if match else [])
        if not any(self._of_group(text)):  # the name of a group is not a misspelt word
            words.update(dict.fromkeys(self._misspelt(text)))
        for head in chain([text], heads(text)):
            of_kind = sorted(self._of_group(head), key=lambda word: word not in preferred)
            words.update(dict.fromkeys([*of_kind, *self._with_token(head)]))
            if len(words) >= count:
                break
        return tuple(words)[:count]

    def complete(self, text: str, count: int = 8) -> tuple[Completion, ...]:
        """Return words that begin with a text, then those with a part that does, synonyms, and similar spellings."""
        start = normalize_text(text).strip(PUNCTUATION)
        if not start:
            return ()
        completions: dict[str, Completion] = {}

        def add(words: Iterable[tuple[str, str]]) -> None:
            for word, typed in words:
                if len(completions) >= count:
                    return
                completions.setdefault(word, Completion(word, typed))

        spellings = [(word, normalize_text(word)) for word in self.words]
        prefix_matches = [(word, spelling) for word, spelling in spellings if spelling.startswith(start)]
        add((word, word) for word, _ in sorted(prefix_matches, key=lambda pair: len(pair[1])))
        add((word, word) for word, spelling in spellings if any(part.startswith(start) for part in spelling.split()))
        for typed, synonym_words in _typed_synonyms().items():
            if typed.startswith(start):
                add((word, typed) for word in map(self._word_or_base, synonym_words) if word)
        match = self.find(text)
        add([(match.word, match.word)] if match else [])
        add((word, word) for word in self._misspelt(text))
        if len(start) >= _MIN_TYPED:
            by_prefix = {spelling[: len(start)]: word for word, spelling in reversed(spellings[:_MAX_COMPARED])}
            close = get_close_matches(start, by_prefix, n=3, cutoff=_PREFIX_SIMILARITY)
            add((by_prefix[prefix], by_prefix[prefix]) for prefix in close)
        return tuple(completions.values())

    def _misspelt(self, text: str) -> list[str]:
        """Return words with the same first letter and nearly the same other letters."""
        typed = normalize_text(text).strip(PUNCTUATION)[:_MAX_TYPED]
        if len(typed) < _MIN_TYPED:
            return []
        words = reversed(self.words[:_MAX_COMPARED])
        by_spelling = {normalize_text(base_of(word))[:_MAX_TYPED]: word for word in words}
        by_spelling = {name: word for name, word in by_spelling.items() if name.startswith(typed[0])}
        close = get_close_matches(typed, by_spelling, n=3, cutoff=_TYPO_SIMILARITY)
        if close:
            return [by_spelling[name] for name in close]
        if len(typed) < _MIN_SYNONYM:
            return []
        synonyms = [name for name in _typed_synonyms() if len(name) >= _MIN_SYNONYM and name[0] == typed[0]]
        matches = map(self._look_up, get_close_matches(typed, synonyms, n=1, cutoff=_TYPO_SIMILARITY))
        return [match[0] for match in matches if match is not None]

    def _word_or_base(self, name: str) -> str | None:
        """Return the word with this spelling, or else with this spelling before its qualifier."""
        return self._keys.get(_spelling_key(name)) or self._bases.get(_spelling_key(base_of(name)))

    def _of_group(self, text: str) -> Iterator[str]:
        """Yield the words of the groups that a text names or belongs to."""
        forms = {_spelling_key(form) for form in _forms(text)}
        for group, members in _table()["groups"].items():
            if _spelling_key(group) in forms or any(_spelling_key(member) in forms for member in members):
                for member in (group, *members):
                    word = self._word_or_base(member)
                    if word is not None and _spelling_key(word) not in forms:
                        yield word

    def _with_token(self, text: str) -> list[str]:
        """Return words of several parts, one of which is the text; those that end with it come first."""
        forms = {form for form in _forms(text) if form}
        ends = [word for word, parts in self._multi_word if parts[-1] in forms]
        return ends + [word for word, parts in self._multi_word if not forms.isdisjoint(parts[:-1])]


def _forms(text: str) -> Iterator[str]:
    """Yield a text normalized, and with its last word in the singular or the plural."""
    normalized = normalize_text(text).strip(PUNCTUATION)
    yield normalized
    before, _, last = normalized.rpartition(" ")
    for form in _numbers(last):
        yield f"{before} {form}".strip()


def _numbers(word: str) -> Iterator[str]:
    if word in IRREGULAR:
        yield IRREGULAR[word]
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


@cache
def _table() -> dict[str, dict[str, Any]]:
    return json.loads(SYNONYMS.read_text("utf-8"))


def members_of(kind: str) -> frozenset[str]:
    """Return the names of what is of a kind, such as "penguin" for "birds"; empty if a text names no kind."""
    forms, groups = set(_forms(kind)), _table()["groups"]
    return frozenset(base_of(member) for group in forms & groups.keys() for member in groups[group])


@cache
def _typed_synonyms() -> dict[str, list[str]]:
    """Return each synonym, normalized, with and without its qualifier, and the words that it matches."""
    words_by_synonym: dict[str, list[str]] = {}
    for name in ("lvis", "everyday"):
        for word, synonyms in _table()[name].items():
            for synonym in synonyms:
                for form in {normalize_text(synonym), normalize_text(base_of(synonym))}:
                    words_by_synonym.setdefault(form, []).append(word)
    return words_by_synonym


@cache
def _synonyms() -> dict[str, list[str]]:
    """Return, by the key of a word or a synonym, the words that it matches, then its synonyms."""
    synonyms_by_key: dict[str, list[str]] = {}
    for typed, words in _typed_synonyms().items():
        synonyms_by_key.setdefault(_spelling_key(typed), []).extend(words)
    for name in ("lvis", "everyday"):
        for word, texts in _table()[name].items():
            for form in {_spelling_key(word), _spelling_key(base_of(word))}:
                synonyms_by_key.setdefault(form, []).extend(texts)
    return synonyms_by_key


@cache
def shipped_words() -> Vocabulary:
    """Return the words of the table that ships."""
    from liftcore.text import LVIS_TABLE
    from liftcore.text.table import TableEncoder

    return Vocabulary(TableEncoder.open(LVIS_TABLE).words)
