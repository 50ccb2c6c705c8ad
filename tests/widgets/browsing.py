"""A browser for tests: what goes wrong on a page is collected, and nothing may come from another host."""

from __future__ import annotations

import os
import re
import shutil
import socket
import subprocess
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from urllib.parse import urlsplit

import panel as pn
import pytest
from panel.io.server import get_server
from playwright.sync_api import Browser, Page, Playwright, expect

#: What Chromium says about drawing without a graphics card is no fault of the page.
HARMLESS = re.compile("GPU stall|willReadFrequently")
#: Milliseconds; a machine may have other work.
PATIENCE = 60_000
expect.set_options(timeout=PATIENCE)
# No graphics card, WebGL in software.
_ARGUMENTS = ("--no-sandbox", "--disable-gpu", "--enable-unsafe-swiftshader")
_LOCAL = {"127.0.0.1", "localhost"}


def browser_program() -> str:
    """Return Chromium; without it the test is skipped."""
    found = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
    if found is None:
        pytest.skip("no Chromium is installed: apt-get install chromium")
    return found


def launch(playwright: Playwright, *arguments: str) -> Browser:
    """Return a new browser."""
    return playwright.chromium.launch(executable_path=browser_program(), args=[*_ARGUMENTS, *arguments])


def collect_problems(page: Page, problems: list[str], *, below: str = "/") -> None:
    """Append errors and warnings of the console, requests that fail, and those that leave the server.

    A page that is served below a prefix may ask for nothing outside it but Panel's own icon, which is not there.
    """

    def note(kind: str, text: str, url: str) -> None:
        if kind in {"error", "warning"} and not HARMLESS.search(text) and "favicon" not in url:
            problems.append(f"{kind}: {text[:300]}")

    def check(url: str) -> None:
        address = urlsplit(url)
        inside = address.hostname in _LOCAL and address.path.startswith(below)
        if address.scheme not in {"data", "blob"} and not inside and "favicon" not in address.path:
            problems.append(f"outside: {url[:200]}")

    page.set_default_timeout(PATIENCE)
    page.on("console", lambda said: note(said.type, said.text, said.location["url"]))
    page.on("pageerror", lambda error: problems.append(f"page: {error} {error.stack}"))
    page.on("request", lambda request: check(request.url))
    page.on("requestfailed", lambda request: problems.append(f"failed: {request.url[:200]}"))


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
def server_of(*command: object, port: int, prefix: str = "") -> Iterator[str]:
    """Run Python with these arguments until the end of the block; it says that it serves. Yield its address."""
    with subprocess.Popen([sys.executable, *map(str, command)], stdout=subprocess.PIPE, text=True) as server:
        try:
            assert server.stdout is not None
            assert f":{port}" in server.stdout.readline()
            yield f"http://localhost:{port}{prefix}/"
        finally:
            server.terminate()
            # The server says good-bye: its pipe has to be open until it is gone.
            server.communicate(timeout=20)


@contextmanager
def dashboard_server(
    runs_dir: Path, data_dirs: Sequence[Path], *more: str, port: int | None = None
) -> Iterator[str]:
    """Serve the dashboard as the command does, and give its address."""
    port = port or free_port()
    command = ["-m", "toolkit", "dashboard", "--runs", runs_dir, "--port", port, *more, "--data", *data_dirs]
    with server_of(*command, port=port) as address:
        yield address


def serve_app(make: Callable[[], pn.viewable.Viewable], port: int, prefix: str = "") -> None:
    """Serve a page of a test's own until the process is told to end; say so on the first line."""
    server = get_server(
        make,
        port=port,
        address="127.0.0.1",
        prefix=prefix,
        websocket_origin=[f"127.0.0.1:{port}", f"localhost:{port}"],
    )
    print(f"http://localhost:{port}{prefix}/", flush=True)
    server.run_until_shutdown()
