"""The end of a run's log."""

from __future__ import annotations

import panel as pn

from toolkit.errors import DataError
from toolkit.runs.folder import RunFolder
from toolkit.runs.markup import element
from toolkit.widgets.style import html_pane, show_html

#: Most bytes of the log that are read, from its end.
MOST_BYTES = 16 * 1024


class LogTail(pn.viewable.Viewer):
    """The last lines, the newest in sight. :meth:`follow` chooses a run, :meth:`refresh` reads the file again."""

    def __init__(self) -> None:
        super().__init__()
        self._run: RunFolder | None = None
        self._seen: tuple[int, int] | None = None
        self._pane = html_pane()

    def __panel__(self) -> pn.viewable.Viewable:
        return self._pane

    def follow(self, run: RunFolder | None) -> None:
        """Show another run, none for None."""
        self._run, self._seen = run, None
        show_html(self._pane)

    def refresh(self) -> None:
        """Show what was written since the last time. Raises :class:`DataError` where the file cannot be read."""
        if self._run is None:
            return
        path = self._run.log_file
        try:
            stat = path.stat()
            seen = stat.st_size, stat.st_mtime_ns
            if seen == self._seen:
                return
            with path.open("rb") as handle:
                handle.seek(max(0, stat.st_size - MOST_BYTES))
                text = handle.read(MOST_BYTES).decode("utf-8", errors="replace")
        except OSError as error:
            raise DataError(f"Cannot read {path}", expected="the log of a run", found=str(error)) from error
        self._seen = seen
        if stat.st_size > MOST_BYTES:
            text = "…\n" + text.partition("\n")[2]
        # The keyboard scrolls what has the focus; aria-live would read every line aloud.
        log = element("div", element("pre", text), class_="log", tabindex="0", role="region", aria_label="Log")
        show_html(self._pane, *((element("h2", "Log"), log) if text else ()))
