"""Installs a workshop bundle with the network cut, and works with it: python tests/benchmarks/workshop_offline.py

Everything below runs in a network namespace of its own that has no route but its own loopback (``unshare --net``,
Linux, as root): what would reach for the network fails. Installed is into a new folder; then the check that comes
with the bundle is run, a notebook at its small size, and the dashboard is asked for its page. Times and sizes are
printed.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import socket
import subprocess
import sys
import tempfile
import time
import urllib.request
from collections.abc import Callable
from pathlib import Path

#: An address that answers from every machine with a network.
OUTSIDE = ("1.1.1.1", 443)
PORT = 5099
#: Seconds until the dashboard has to answer, and the notebook to end.
PATIENCE, LONGEST = 180.0, 900.0


def main() -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n\n")[0])
    parser.add_argument("--bundle", type=Path, default=Path("dist/workshop"), help="built by make workshop")
    parser.add_argument("--notebook", default="00_tour", help="that is run at its small size")
    parser.add_argument("--python", default=sys.executable, help="that a participant would have")
    parser.add_argument("--keep", type=Path, metavar="DIR", help="install there, and leave it [a temporary folder]")
    parser.add_argument("--inside", action="store_true", help=argparse.SUPPRESS)
    given = parser.parse_args()
    if not given.inside:
        if sys.platform != "linux" or os.geteuid() != 0 or shutil.which("unshare") is None:
            print("A network namespace needs Linux, root and unshare: not measured.", file=sys.stderr)
            return 2
        command = ["unshare", "--net", sys.executable, __file__, *sys.argv[1:], "--inside"]
        return subprocess.run(command, check=False).returncode
    subprocess.run(["ip", "link", "set", "lo", "up"], check=True)
    require_cut_network()
    place = Path(tempfile.mkdtemp(prefix="workshop-offline-")) if given.keep is None else given.keep
    try:
        return prove(given.bundle.resolve(), place / "workshop", given.notebook, given.python)
    finally:
        if given.keep is None:
            shutil.rmtree(place)


def require_cut_network() -> None:
    try:
        socket.create_connection(OUTSIDE, timeout=5).close()
    except OSError as error:
        print(f"network: cut ({error})", flush=True)
        return
    raise SystemExit("The network is there: nothing would be proven.")


def prove(bundle: Path, folder: Path, notebook: str, python: str) -> int:
    print(f"bundle: {size(bundle) / 1e9:.2f} GB in {bundle}", flush=True)
    steps: dict[str, Callable[[], None]] = {
        "install": lambda: call([python, str(bundle / "install.py"), "--to", str(folder)], bundle),
        "install again": lambda: call([python, str(bundle / "install.py"), "--to", str(folder)], bundle),
        "start.py check, first": lambda: call([python, "start.py", "check"], folder),
        "start.py check, again": lambda: call([python, "start.py", "check"], folder),
        f"notebook {notebook}, FAST=1": lambda: run_notebook(folder, notebook),
        "dashboard answers": lambda: ask_dashboard(folder, python),
    }
    seconds = {}
    for name, step in steps.items():
        print(f"--- {name}", flush=True)
        began = time.monotonic()
        step()
        seconds[name] = time.monotonic() - began
    print("\n| step | seconds |\n|---|---|")
    print("\n".join(f"| {name} | {value:.0f} |" for name, value in seconds.items()))
    print(f"installed: {size(folder / '.venv') / 1e9:.2f} GB in .venv, {size(folder) / 1e9:.2f} GB in all")
    return 0


def call(command: list[str], folder: Path) -> None:
    subprocess.run(command, cwd=folder, check=True)


def size(folder: Path) -> int:
    return sum(path.lstat().st_size for path in folder.rglob("*") if path.is_file() and not path.is_symlink())


def run_notebook(folder: Path, name: str) -> None:
    """Run it as JupyterLab would, in its folder, and require that no cell fails."""
    python = folder / ".venv" / "bin" / "python"
    command = [str(python), "-m", "jupyter", "nbconvert", "--to", "notebook", "--execute"]
    command += [f"{name}.ipynb", "--output", f"{name}-done.ipynb", "--output-dir", str(folder)]
    subprocess.run(command, cwd=folder / "notebooks", env={**os.environ, "FAST": "1"}, check=True, timeout=LONGEST)
    cells = json.loads((folder / f"{name}-done.ipynb").read_text(encoding="utf-8"))["cells"]
    outputs = [output for cell in cells for output in cell.get("outputs", [])]
    assert outputs
    assert not [output for output in outputs if output["output_type"] == "error"]


def ask_dashboard(folder: Path, python: str) -> None:
    """Start it as a participant does, and require its page and the names of the runs made beforehand."""
    command = [python, "start.py", "dashboard", "--port", str(PORT)]
    server = subprocess.Popen(command, cwd=folder, env={**os.environ, "BROWSER": "true"}, start_new_session=True)
    try:
        page = answer(f"http://127.0.0.1:{PORT}/")
        assert "bokeh" in page.lower()
    finally:
        os.killpg(server.pid, 15)
        server.wait(timeout=30)


def answer(address: str) -> str:
    until = time.monotonic() + PATIENCE
    while True:
        try:
            with urllib.request.urlopen(address, timeout=60) as page:
                return str(page.read().decode("utf-8"))
        except OSError:
            if time.monotonic() > until:
                raise
            time.sleep(0.5)


if __name__ == "__main__":
    raise SystemExit(main())
