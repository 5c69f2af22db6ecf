"""What one file or request may hold, beside the sizes that the operator sets (`service.settings`)."""

from __future__ import annotations

# Texts, in characters
VIEW_CHARACTERS = 500  # of a view's name, so that a query can say it
WORD_CHARACTERS = 1000  # of a word, of a text that is asked for, and of what a pack is named
FILE_CHARACTERS = 4 << 20  # of all names, or all words, of a file: a hundred thousand of 40
PAGE_CHARACTERS = 256 << 10  # of the names, or words, of one answer
LIFT_NAME_CHARACTERS = 100
SETTING_CHARACTERS = 1000  # of a name or a text among settings
ASKED_CHARACTERS = 4000  # of the texts of a question together: an encoder takes seconds for more

# Numbers
PACKS = 64  # of a lift
SETTINGS = 100  # of a lift
ASKED = 32  # texts, or examples, of a question
VECTOR = 65_536  # numbers of a vector
WORDS = 4096  # that are asked at once
PAGE = 1000  # records of a list, names or views in one answer

# JSON bodies, before they are parsed: what a question needs at most is 4,096 words, or 32 vectors of 4,096 numbers
BODY_BRACKETS = 10_000
BODY_COMMAS = 140_000

# Zips
PHOTOS = 10_000
DIRECTORY_BYTES = 8 << 20  # of the list of what is in a zip of photos: of 20,000 files with long names
