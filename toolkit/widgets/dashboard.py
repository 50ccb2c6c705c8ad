"""The dashboard as a page that a server hands out, one for each visitor."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import panel as pn

from toolkit.widgets.shell import Shell
from toolkit.widgets.style import FONT, GROUND, LocalFast, page_css

TITLE = "Sightline Toolkit"
#: Milliseconds between looks at the disk.
REFRESH = 3000


def dashboard(
    runs_dir: Path, data_dirs: Sequence[Path] = (), *, clusters: Sequence[str] = ()
) -> pn.template.FastListTemplate:
    """Return the page for one visitor, ready to be served; everything it loads comes from the installation.

    Parameters are those of :class:`~toolkit.widgets.shell.Shell`.
    """
    begin_page()
    dark = dark_wanted()
    shell = Shell(runs_dir, data_dirs, pn.state.location, clusters=clusters, dark=dark)
    pn.state.onload(shell.loaded)
    pn.state.add_periodic_callback(shell.refresh, period=REFRESH)
    return page_template(shell, dark=dark)


def begin_page() -> None:
    """Load Panel's extensions for a page that is about to be made, all of them from this installation."""
    pn.extension("plotly", "tabulator")


def dark_wanted() -> bool:
    """Return whether the visitor's address asks for a dark ground."""
    asked: bytes = pn.state.session_args.get("theme", [b""])[0]
    return asked == b"dark"


def page_template(content: pn.viewable.Viewer, *, dark: bool, title: str = TITLE) -> pn.template.FastListTemplate:
    """Return a page in the toolkit's looks with nothing but ``content``."""
    return pn.template.FastListTemplate(
        title=title,
        main_layout=None,
        main=[content],
        raw_css=[page_css(dark=dark)],
        accent="#2563eb",
        design=LocalFast,
        background_color=GROUND["dark" if dark else "light"],
        font=FONT,
        font_url="",
        # It would turn at each look at the disk.
        busy_indicator=None,
        meta_viewport="width=device-width, initial-scale=1",
    )
