"""Runs side by side: ``panel serve dashboards/runs.py --args --runs runs``."""

from __future__ import annotations

import argparse
import os
import sys
from pathlib import Path

from toolkit.widgets.page import runs_page

parser = argparse.ArgumentParser(description=__doc__)
parser.add_argument("--runs", type=Path, default=Path(os.environ.get("TOOLKIT_RUNS") or "runs"))
runs_page(parser.parse_args(sys.argv[1:]).runs).servable()
