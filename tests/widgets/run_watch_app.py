"""A page with the tabs on which runs are started and followed: ``python run_watch_app.py RUNS DATA PORT``."""

from __future__ import annotations

import sys
from pathlib import Path

import panel as pn
from panel.io.server import get_server

from toolkit.widgets.run_page import RunPage
from toolkit.widgets.style import FONT, GROUND, LocalFast, page_css
from toolkit.widgets.watch_page import WatchPage

# Milliseconds; a test has less patience than a person.
REFRESH = 500


def page(runs_dir: Path, data_dir: Path) -> pn.template.FastListTemplate:
    """Return the page; the address says which tab is open first and whether the ground is dark."""
    pn.extension("plotly", notifications=False)
    dark = pn.state.session_args.get("theme", [b""])[0] == b"dark"

    def show(tab: str, run_id: str) -> None:
        if tab == "watch":
            watch.selected = run_id
            tabs.active = 1

    watch = WatchPage(runs_dir, show=show, dark=dark)
    run = RunPage(runs_dir, [data_dir], show=show, dark=dark)
    tabs = pn.Tabs(("Run", run), ("Watch", watch), dynamic=False, sizing_mode="stretch_width")
    asked = pn.state.session_args.get("run", [b""])[0].decode()
    if asked:
        watch.selected = asked
        tabs.active = 1
    pn.state.add_periodic_callback(lambda: (run, watch)[tabs.active].refresh(), period=REFRESH)
    return pn.template.FastListTemplate(
        title="Run and watch",
        main_layout=None,
        main=[tabs],
        raw_css=[page_css(dark=dark)],
        accent="#2563eb",
        design=LocalFast,
        background_color=GROUND["dark" if dark else "light"],
        font=FONT,
        font_url="",
        busy_indicator=None,
        meta_viewport="width=device-width, initial-scale=1",
    )


if __name__ == "__main__":
    runs, data, port = Path(sys.argv[1]), Path(sys.argv[2]), int(sys.argv[3])
    server = get_server(
        lambda: page(runs, data),
        port=port,
        address="127.0.0.1",
        websocket_origin=[f"127.0.0.1:{port}", f"localhost:{port}"],
    )
    print(f"http://localhost:{port}/", flush=True)
    server.run_until_shutdown()
