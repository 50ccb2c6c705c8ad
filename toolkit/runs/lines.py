"""Text files that grow by whole lines, each at once visible to readers."""

from __future__ import annotations

from pathlib import Path

from toolkit.files import disk_errors


class LineFile:
    """Appends lines to ``path``.

    An unterminated last line, which a killed process or a full disk left, is cut off at opening.

    Raises
    ------
    RunError
        When the disk is full or may not be written.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        with disk_errors(path, "writing"):
            self._file = path.open("ab", buffering=0)
            content = path.read_bytes()
            whole = content.rfind(b"\n") + 1
            if whole < len(content):
                self._file.truncate(whole)

    def append(self, text: str) -> None:
        """Append ``text``, which ends with a newline."""
        rest = memoryview(text.encode())
        with disk_errors(self._path, "writing"):
            while rest:  # An unbuffered file may take a part only, as on a disk that fills.
                rest = rest[self._file.write(rest) or 0 :]

    def close(self) -> None:
        """End writing. Nothing is buffered, so nothing can be lost here."""
        self._file.close()
