"""Names and ids of runs: short texts that can never lead out of the runs folder."""

from __future__ import annotations

import re
import secrets
from datetime import UTC, datetime

from toolkit.errors import RunError

LONGEST_NAME = 100
_ID = re.compile(r"\d{8}-\d{6}-[a-z0-9][a-z0-9_-]*-[0-9a-f]{4}")
_LATEST = re.compile(r"latest(?:-(\d{1,6}))?")


def check_name(text: str, what: str = "Run name") -> str:
    """Return ``text`` where it may name a run.

    Raises
    ------
    RunError
        For an empty or overlong name, path separators, ``..``, a leading dot or dash, control characters, spaces
        at an end, and the reserved words ``latest`` and ``latest-<n>``.
    """
    wrong = ""
    if not text.strip():
        wrong = "an empty name"
    elif len(text) > LONGEST_NAME:
        wrong = f"{len(text)} characters"
    elif not text.isprintable():
        wrong = "control characters"
    elif any(mark in text for mark in "/\\:"):
        wrong = "a path separator"
    elif ".." in text:
        wrong = "'..'"
    elif text[0] in ".-":
        wrong = f"a leading '{text[0]}'"
    elif text != text.strip():
        wrong = "spaces at an end"
    elif _LATEST.fullmatch(text):
        wrong = "the reserved word 'latest'"
    if wrong:
        raise RunError(
            f"{what} {text!r} cannot be used",
            expected=f"one line of 1 to {LONGEST_NAME} characters without '/', '\\', ':' and '..' that starts with "
            "neither dot nor dash and is not 'latest'",
            found=wrong,
        )
    return text


def is_run_id(text: str) -> bool:
    """Whether ``text`` has the form of a run's id."""
    return _ID.fullmatch(text) is not None


def recipe_of_id(text: str) -> str:
    """Return the name of the recipe in a run's id, empty where ``text`` is none."""
    return text[16:-5] if is_run_id(text) else ""


def latest_offset(text: str) -> int | None:
    """Return how many runs back ``latest`` (0) or ``latest-<n>`` (n) points; None for every other text."""
    match = _LATEST.fullmatch(text)
    return int(match[1] or 0) if match else None


def new_id(recipe: str, now: datetime | None = None) -> str:
    """Return a fresh id ``<yyyymmdd-hhmmss>-<recipe>-<4 hex>``; the time is UTC.

    Raises
    ------
    RunError
        Where the recipe's name is not made of small letters, digits, dashes and underscores.
    """
    moment = (now or datetime.now(UTC)).strftime("%Y%m%d-%H%M%S")
    made = f"{moment}-{recipe}-{secrets.token_hex(2)}"
    if not is_run_id(made):
        raise RunError(
            f"Recipe name {recipe!r} cannot be part of a run's id",
            expected="small letters, digits, '-' and '_'",
            todo="Rename the recipe",
        )
    return made
