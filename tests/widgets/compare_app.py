"""A page with the tab that compares and nothing else: ``python compare_app.py RUNS PORT [MILLISECONDS]``."""

from __future__ import annotations

import sys
from pathlib import Path

import panel as pn
from panel.io.server import get_server

from toolkit.widgets.address import Address
from toolkit.widgets.compare_page import ComparePage
from toolkit.widgets.dashboard import begin_page, dark_wanted, page_template


def page(runs_dir: Path, every: int) -> pn.template.FastListTemplate:
    """Return the page for one visitor, which looks at the disk every so many milliseconds."""
    begin_page()
    dark = dark_wanted()
    compare = ComparePage(runs_dir, Address(pn.state.location), dark=dark, wait=True)
    pn.state.onload(compare.open)
    pn.state.add_periodic_callback(compare.refresh, period=every)
    return page_template(compare, dark=dark, title="Compare")


if __name__ == "__main__":
    runs, port, every = Path(sys.argv[1]), int(sys.argv[2]), int(sys.argv[3]) if len(sys.argv) > 3 else 3000
    server = get_server(
        lambda: page(runs, every),
        port=port,
        address="127.0.0.1",
        websocket_origin=[f"127.0.0.1:{port}", f"localhost:{port}"],
    )
    print(f"http://localhost:{port}/", flush=True)
    server.run_until_shutdown()
