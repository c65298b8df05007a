"""What settings and text files can declare, and what `input` and `validation` do with it."""

from patchproof.base.declared import Declaration

_FILES = "TOML, JSON, CSV"
DECLARED: tuple[Declaration, ...] = (
    Declaration(_FILES, "UTF-8, with or without a byte order mark", "used", "the mark is skipped"),
    Declaration(_FILES, "UTF-16, with or without a byte order mark", "refused", "it is named: save it as UTF-8"),
    Declaration(_FILES, "bytes that are not UTF-8, such as Latin-1", "refused", "line and byte are named"),
    Declaration("TOML, JSON", "an unknown key of settings", "refused", "with the nearest known one"),
    Declaration("CSV", "semicolons or tabs as separators", "refused", "they are named: save it with commas"),
    Declaration("CSV", "an apostrophe before a formula", "used", "it is no part of the text"),
)
