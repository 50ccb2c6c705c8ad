"""A page with the tab of data alone: ``python data_app.py RUNS DATA PORT``."""

from __future__ import annotations

import sys
from pathlib import Path

import panel as pn
from panel.io.server import get_server

from toolkit.widgets.data_page import DataPage
from toolkit.widgets.style import FONT, GROUND, LocalFast, page_css
from toolkit.widgets.task import cancel_all

# Milliseconds; a test has less patience than a person.
REFRESH = 500


def page(runs_dir: Path, data_dir: Path) -> pn.template.FastListTemplate:
    """Return the page; the address says whether the ground is dark."""
    pn.extension("plotly", notifications=False)
    dark = pn.state.session_args.get("theme", [b""])[0] == b"dark"
    said = pn.pane.HTML("")

    def show(tab: str, capture: str) -> None:
        said.object = f"asked for {tab} of {Path(capture).name}"

    data = DataPage(runs_dir, [data_dir], show=show, dark=dark)
    pn.state.add_periodic_callback(data.refresh, period=REFRESH)
    return pn.template.FastListTemplate(
        title="Data",
        main_layout=None,
        main=[pn.Column(data, said, sizing_mode="stretch_width")],
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
    cancel_all()
