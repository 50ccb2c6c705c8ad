"""Serving the page of runs to browsers on this machine."""

from __future__ import annotations

import errno
import os
import socket
from pathlib import Path

from toolkit.errors import RunError
from toolkit.optional import require

_ADDRESS = "127.0.0.1"


def serve(runs_dir: Path, *, port: int = 5006, open_browser: bool = False) -> None:
    """Serve the runs in ``runs_dir`` until Ctrl-C, to this machine alone.

    Parameters
    ----------
    runs_dir:
        Folder of the runs; it need not be there yet.
    port:
        Where the page is found.
    open_browser:
        Whether to open it.

    Raises
    ------
    MissingDependencyError
        Where Panel is not installed.
    RunError
        Where the port is taken or may not be used.
    """
    require("panel")
    from panel.io.server import get_server

    from toolkit.widgets.page import TITLE, runs_page

    _refuse_taken(port)
    server = get_server(
        lambda: runs_page(runs_dir),
        port=port,
        address=_ADDRESS,
        # Pages from elsewhere that a browser on this machine has open do not get in.
        websocket_origin=[f"{_ADDRESS}:{port}", f"localhost:{port}"],
        title=TITLE,
        show=open_browser,
    )
    print(f"The runs in {runs_dir} are at http://localhost:{port} (Ctrl-C ends this)", flush=True)
    server.run_until_shutdown()


def _refuse_taken(port: int) -> None:
    """Raise :class:`RunError` where ``port`` cannot be had. The server's own failure would leave sockets open."""
    if not 0 < port < 2**16:
        raise RunError(f"{port} is no port", expected="a number from 1 to 65535", todo="Choose another one")
    with socket.socket() as probe:
        if os.name == "posix":
            # A server that ended a moment ago keeps nobody out; elsewhere this would let two share a port.
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind((_ADDRESS, port))
        except OSError as error:
            taken = error.errno == errno.EADDRINUSE
            raise RunError(
                f"Port {port} is {'taken by another program' if taken else 'not to be had'}",
                expected="a free port",
                found=error.strerror or str(error),
                todo="Choose another one, or end the program that has it",
            ) from error
