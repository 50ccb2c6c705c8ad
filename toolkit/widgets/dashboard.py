"""The dashboard as a page that a server hands out, one for each visitor."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import panel as pn

from toolkit.widgets.page import page_template
from toolkit.widgets.shell import Shell

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
