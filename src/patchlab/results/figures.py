"""The page of current figures: `measured.md`, which stands beside the configs and data that it quotes."""

import re
from pathlib import Path

from patchproof.base.errors import Refused
from patchproof.base.validation import spelling_hint

_PAGE = Path(__file__).with_name("measured.md")


def figures_page(name: str | None = None) -> str:
    """The whole page as Markdown, or its sections whose heading holds `name`; refused where none does."""
    page = _PAGE.read_text(encoding="utf-8")
    if name is None:
        return page
    sections = re.split(r"^(?=## )", page, flags=re.MULTILINE)[1:]
    found = [section for section in sections if name.lower() in section.partition("\n")[0].lower()]
    if not found:
        headings = [section.partition("\n")[0].removeprefix("## ") for section in sections]
        raise Refused(
            f"a word of one of the headings {', '.join(headings)}", f'"{name}"', spelling_hint(name, headings)
        )
    return "".join(found)
