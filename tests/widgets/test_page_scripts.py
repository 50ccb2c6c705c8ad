"""The page loads what its first sight needs, and the server stays small."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

from toolkit.widgets.page import lean_scripts

PLOTLY = '<script type="text/javascript" src="prefix/bundled/plotlyplot/plotly-3.1.0.min.js"></script>'
MATHJAX = '<script type="text/javascript" src="static/js/bokeh-mathjax.min.js?v=1"></script>'
OTHER = '<script type="text/javascript" src="static/js/bokeh.min.js?v=1"></script>'

# Everything that the tabs import and ask for when they are made and a run is to be started.
SMALL = """
import sys
from pathlib import Path
from toolkit.runs.machine import devices_here, threads_elsewhere
from toolkit.widgets.run_page import RunPage
from toolkit.widgets.shell import Shell
folder = Path(sys.argv[1])
shell = Shell(folder, [folder])
for tab in ("data", "run", "watch", "compare", "view", "sweep"):
    shell.tab = tab
assert set(shell.pages) == {"data", "run", "watch", "compare", "view", "sweep"}, shell.pages
threads_elsewhere()
assert "torch" not in sys.modules, "PyTorch was imported"
"""


def test_plotly_is_loaded_from_its_own_address_later_and_mathjax_never() -> None:
    written = lean_scripts(f"{PLOTLY}\n{OTHER}\n{MATHJAX}\n")

    assert 'script.src = "prefix/bundled/plotlyplot/plotly-3.1.0.min.js"' in written
    assert PLOTLY not in written
    assert "mathjax" not in written
    assert OTHER in written


def test_scripts_that_are_not_known_stay() -> None:
    assert lean_scripts(OTHER) == OTHER
    assert lean_scripts("") == ""


def test_no_tab_brings_pytorch_into_the_server(tmp_path: Path) -> None:
    done = subprocess.run([sys.executable, "-c", SMALL, str(tmp_path)], capture_output=True, text=True, check=False)

    assert done.returncode == 0, done.stderr
