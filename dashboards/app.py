"""The dashboard: ``panel serve dashboards/app.py --args --runs runs --data data``.

``toolkit dashboard`` serves the same. This file is for Panel's own options, as OAuth (``--oauth-provider``).
"""

from __future__ import annotations

import argparse
import os
import sys
from pathlib import Path

from toolkit.widgets.dashboard import dashboard

parser = argparse.ArgumentParser(description=__doc__)
parser.add_argument("--runs", type=Path, default=Path(os.environ.get("TOOLKIT_RUNS") or "runs"))
parser.add_argument("--data", type=Path, nargs="+", default=[Path("data")])
parser.add_argument("--cluster", nargs="+", default=[])
arguments = parser.parse_args(sys.argv[1:])
dashboard(arguments.runs, arguments.data, clusters=arguments.cluster).servable()
