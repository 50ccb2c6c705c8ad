"""A browser for tests: what goes wrong on a page is collected, and nothing may come from another host."""

from __future__ import annotations

import os
import re
import socket
import subprocess
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from urllib.parse import urlsplit

from playwright.sync_api import Page

#: What Chromium says about drawing without a graphics card is no fault of the page.
HARMLESS = re.compile("GPU stall|WebGL|willReadFrequently")
#: Chromium's arguments: no graphics card, WebGL in software.
ARGUMENTS = ["--no-sandbox", "--disable-gpu", "--enable-unsafe-swiftshader"]
_LOCAL = {"127.0.0.1", "localhost"}


def collect_problems(page: Page, problems: list[str]) -> None:
    """Append errors and warnings of the console, and requests that leave this machine."""

    def note(kind: str, text: str) -> None:
        if kind in {"error", "warning"} and not HARMLESS.search(text):
            problems.append(f"{kind}: {text[:300]}")

    def check(url: str) -> None:
        address = urlsplit(url)
        if address.scheme not in {"data", "blob"} and address.hostname not in _LOCAL:
            problems.append(f"outside: {url[:200]}")

    page.on("console", lambda said: note(said.type, said.text))
    page.on("pageerror", lambda error: problems.append(f"page: {error} {error.stack}"))
    page.on("request", lambda request: check(request.url))


def take_picture(page: Page, name: str) -> None:
    """Keep what the page looks like, where ``TOOLKIT_SCREENSHOTS`` names a folder."""
    folder = os.environ.get("TOOLKIT_SCREENSHOTS")
    if folder:
        Path(folder).mkdir(parents=True, exist_ok=True)
        page.screenshot(path=Path(folder) / f"{name}.png")


def free_port() -> int:
    """Return a port that nobody has."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


@contextmanager
def dashboard_server(
    runs_dir: Path, data_dirs: Sequence[Path], *more: str, port: int | None = None
) -> Iterator[str]:
    """Serve the dashboard in a process of its own, as the command does, and give its address."""
    port = port or free_port()
    command = [sys.executable, "-m", "toolkit", "dashboard", "--runs", str(runs_dir), "--port", str(port), *more]
    command += ["--data", *map(str, data_dirs)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as server:
        try:
            assert server.stdout is not None
            line = server.stdout.readline()
            assert f":{port}" in line
            yield f"http://localhost:{port}/"
        finally:
            server.terminate()
            # The server says good-bye: its pipe has to be open until it is gone.
            server.communicate(timeout=20)
