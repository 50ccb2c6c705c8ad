"""notes.json: what a person says about a run. It lies in the run's folder and moves with it."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path

from toolkit.errors import DataError, RunError
from toolkit.files import read_json, write_json
from toolkit.runs.folder import RunFolder

#: Most characters of a tag and of a text, and most tags of a run.
LONGEST_TAG = 30
LONGEST_TEXT = 4000
MOST_TAGS = 20


@dataclass(frozen=True, slots=True)
class RunNotes:
    """Tags in the order in which they were given, and a text of any number of lines.

    Raises
    ------
    RunError
        For a tag that is empty, too long, or holds a comma or control characters, too many tags, and a text that
        is too long.
    """

    tags: tuple[str, ...] = ()
    text: str = ""

    def __post_init__(self) -> None:
        for tag in self.tags:
            _check_tag(tag)
        if len(self.tags) > MOST_TAGS or len(set(self.tags)) != len(self.tags):
            raise RunError(
                "Tags cannot be used", expected=f"at most {MOST_TAGS} different ones", found=f"{len(self.tags)}"
            )
        if len(self.text) > LONGEST_TEXT:
            raise RunError(
                "The note is too long",
                expected=f"at most {LONGEST_TEXT} characters",
                found=str(len(self.text)),
                todo="Shorten it",
            )


def notes_file(run: RunFolder) -> Path:
    """Return where a run's notes lie."""
    return run.path / "notes.json"


def split_tags(text: str) -> tuple[str, ...]:
    """Return tags that a person typed with commas between them, each once."""
    return tuple(dict.fromkeys(tag for part in text.split(",") if (tag := " ".join(part.split()))))


def read_notes(run: RunFolder) -> RunNotes:
    """Return the notes of a run; one without has empty ones. Raises :class:`DataError` where they are damaged."""
    path = notes_file(run)
    if not path.is_file():
        return RunNotes()
    content = read_json(path)
    tags = content.get("tags") if isinstance(content, Mapping) else None
    text = content.get("text") if isinstance(content, Mapping) else None
    if not isinstance(tags, list) or not all(isinstance(tag, str) for tag in tags) or not isinstance(text, str):
        raise DataError(f"{path} holds no notes", expected="a list 'tags' of texts and a text 'text'")
    try:
        return RunNotes(tuple(tags), text)
    except RunError as error:
        raise DataError(f"{path} holds notes that cannot be used", found=str(error)) from error


def write_notes(run: RunFolder, notes: RunNotes) -> None:
    """Replace the notes of a run in one step.

    Raises
    ------
    RunError
        Where the run is not there any more, the disk is full or the folder may not be written.
    """
    # Writing makes missing folders: a run that was deleted meanwhile would come back as an empty one.
    if not run.path.is_dir():
        raise RunError(f"Run {run.id} is not there any more", todo="Was it deleted? The bin may still have it")
    write_json(notes_file(run), {"tags": list(notes.tags), "text": notes.text})


def known_tags(tags: Iterable[tuple[str, ...]]) -> list[str]:
    """Return all tags in use, each once, in the order of the alphabet."""
    return sorted({tag for of_run in tags for tag in of_run}, key=str.casefold)


def _check_tag(tag: str) -> None:
    wrong = ""
    if not tag.strip() or tag != tag.strip():
        wrong = "an empty one, or spaces at an end"
    elif len(tag) > LONGEST_TAG:
        wrong = f"{len(tag)} characters"
    elif "," in tag or not tag.isprintable():
        wrong = "a comma or control characters"
    if wrong:
        raise RunError(
            f"Tag {tag[: LONGEST_TAG + 1]!r} cannot be used",
            expected=f"1 to {LONGEST_TAG} characters without commas",
            found=wrong,
        )
