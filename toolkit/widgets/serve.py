"""Serving the dashboard: to this machine alone, or with a password to a network."""

from __future__ import annotations

import errno
import json
import os
import secrets
import socket
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from toolkit.errors import RunError
from toolkit.files import disk_errors
from toolkit.optional import require

LOCAL: Final = "127.0.0.1"
#: Fewer characters are guessed too soon.
SHORTEST_PASSWORD: Final = 8
#: Seconds in which the list of runs is read before anybody asks for it.
_FIRST_LOOK: Final = 1.0


@dataclass(frozen=True, slots=True)
class Opening:
    """To whom the dashboard is served.

    Attributes
    ----------
    port:
        Where it is found.
    host:
        Address that it listens on; any but this machine's own needs passwords.
    passwords:
        JSON file of names and their passwords, ``{"name": "password"}``; None: nobody is asked.
    origins:
        Further addresses ``host[:port]`` by which browsers reach it, as behind a proxy.
    """

    port: int = 5006
    host: str = LOCAL
    passwords: Path | None = None
    origins: tuple[str, ...] = ()


def serve(
    runs_dir: Path,
    data_dirs: Sequence[Path] = (),
    opening: Opening | None = None,
    *,
    clusters: Sequence[str] = (),
    open_browser: bool = False,
) -> None:
    """Serve the dashboard until Ctrl-C.

    Parameters
    ----------
    runs_dir:
        Folder of the runs; it need not be there yet.
    data_dirs:
        Folders at and below which captures lie. New data go into the first one.
    opening:
        To whom; by default to this machine alone, at port 5006.
    clusters:
        Addresses of Dask schedulers on which sweeps may run.
    open_browser:
        Whether to open it.

    Raises
    ------
    MissingDependencyError
        Where Panel is not installed.
    RunError
        Where the port is taken or may not be used, and where a network would get in without a password.
    """
    require("panel")
    from panel.io.server import get_server

    from toolkit.runs.catalogue import shared_catalogue
    from toolkit.widgets.dashboard import dashboard
    from toolkit.widgets.page import TITLE
    from toolkit.widgets.task import cancel_all

    opening = opening or Opening()
    options = _protection(opening)
    _refuse_taken(opening.host, opening.port)
    # The first visitor need not wait for this; what cannot be read the page tells.
    with suppress(RunError):
        catalogue = shared_catalogue(runs_dir.resolve())
        catalogue.refresh(within=_FIRST_LOOK)
        catalogue.numbers()
    server = get_server(
        lambda: dashboard(runs_dir, data_dirs, clusters=clusters),
        port=opening.port,
        address=opening.host,
        # Pages from elsewhere that a browser on this machine has open do not get in.
        websocket_origin=[f"{host}:{opening.port}" for host in (LOCAL, "localhost")] + list(opening.origins),
        title=TITLE,
        show=open_browser,
        **options,
    )
    place = "localhost" if opening.host == LOCAL else opening.host
    print(f"The runs in {runs_dir} are at http://{place}:{opening.port} (Ctrl-C ends this)", flush=True)
    server.run_until_shutdown()
    cancel_all()  # samples that are being made and sets that are being fetched


def _protection(opening: Opening) -> dict[str, Any]:
    """Return Panel's settings of the log-in. Refuses to open to a network without one."""
    if opening.passwords is None:
        if opening.host not in (LOCAL, "localhost"):
            raise RunError(
                f"The dashboard would be open to everyone who reaches {opening.host}, to start and delete runs",
                expected="passwords for whatever is not this machine alone",
                todo='Give --passwords FILE with {"name": "password"}, or leave --host out; panel serve '
                "dashboards/app.py takes Panel's own options for OAuth",
            )
        return {}
    return {
        "basic_auth": _passwords(opening.passwords),
        # Who has logged in has to do so again after a restart.
        "cookie_secret": secrets.token_hex(32),
    }


def _passwords(path: Path) -> dict[str, str]:
    with disk_errors(path, "reading"):
        try:
            found = json.loads(path.read_text(encoding="utf-8"))
        except FileNotFoundError as error:
            raise RunError(f"There is no file of passwords {path}") from error
        except ValueError as error:
            raise RunError(
                f"{path} holds no passwords", expected='JSON, {"name": "password"}', found=str(error)
            ) from error
    fits = isinstance(found, dict) and all(isinstance(value, str) for value in found.values())
    if not fits or not found:
        raise RunError(
            f"{path} holds no passwords", expected='JSON, {"name": "password"}', found=type(found).__name__
        )
    short = [name for name, password in found.items() if len(password) < SHORTEST_PASSWORD]
    if short:
        raise RunError(
            f"Passwords in {path} are too short",
            expected=f"at least {SHORTEST_PASSWORD} characters",
            found="fewer for " + ", ".join(short),
        )
    return {str(name): str(password) for name, password in found.items()}


def _refuse_taken(host: str, port: int) -> None:
    """Raise :class:`RunError` where ``port`` cannot be had. The server's own failure would leave sockets open."""
    if not 0 < port < 2**16:
        raise RunError(f"{port} is no port", expected="a number from 1 to 65535", todo="Choose another one")
    with socket.socket() as probe:
        if os.name == "posix":
            # A server that ended a moment ago keeps nobody out; elsewhere this would let two share a port.
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind((host, port))
        except OSError as error:
            taken = error.errno == errno.EADDRINUSE
            raise RunError(
                f"Port {port} is {'taken by another program' if taken else 'not to be had'}",
                expected="a free port",
                found=error.strerror or str(error),
                todo="Choose another one, or end the program that has it",
            ) from error
