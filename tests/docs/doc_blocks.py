"""The blocks of code in the project's pages, and which of them run.

- ```` ```python ```` runs, all of a page in order, in one process in a folder with ``photos/``; with a title it is
  written to the file of that name instead, and what follows may import it.
- ```` ```toml ```` and others with a title are written, too.
- ```` ```py ```` does not run; the line before it says why: ``<!-- does not run: reason -->``.
- ```` ```sh ```` is not executed; each ``toolkit`` line in it is read by the command line's own parser.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).parents[2]
NOT_RUN = re.compile(r"<!-- does not run: \S.* -->")
_OPEN = re.compile(r"^(?P<indent> *)(?P<fence>`{3,}|~{3,})(?P<info>.*)$")
_TITLE = re.compile(r'title="([^"]+)"')


@dataclass(frozen=True)
class Block:
    """A fenced block: its language, title, text, the line it begins on and the last line with text before it."""

    language: str
    title: str
    text: str
    line: int
    before: str


def pages() -> list[Path]:
    """Return README and every page of the documentation."""
    return [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]


def blocks(page: Path) -> Iterator[Block]:
    """Yield the fenced blocks of a page."""
    lines = page.read_text(encoding="utf-8").split("\n")
    i, before = 0, ""
    while i < len(lines):
        found = _OPEN.match(lines[i])
        if found is None:
            before = lines[i].strip() or before
            i += 1
            continue
        end = next(j for j in range(i + 1, len(lines)) if lines[j].strip() == found["fence"])
        text = "\n".join(line.removeprefix(found["indent"]) for line in lines[i + 1 : end])
        info = found["info"].strip()
        title = _TITLE.search(info)
        yield Block(info.split()[0] if info else "", title[1] if title else "", text + "\n", i + 1, before)
        i, before = end + 1, ""


def prose(page: Path) -> str:
    """Return a page without its fenced blocks and without code in the line."""
    kept, fence = [], ""
    for line in page.read_text(encoding="utf-8").split("\n"):
        found = _OPEN.match(line)
        if fence:
            fence = "" if line.strip() == fence else fence
        elif found is not None:
            fence = found["fence"]
        else:
            kept.append(line)
    return re.sub(r"`[^`\n]*`", "", "\n".join(kept))


def page_id(page: Path) -> str:
    """Return the name of a page in reports of tests."""
    return page.relative_to(ROOT).as_posix()
