"""Measures a sweep of twelve short runs in worker processes of this machine and on a Dask cluster beside them.

``python tests/benchmarks/sweep.py [--work DIR]`` makes the sample flight, then the same grid twice, each time in a
new folder of runs, with two workers of one thread each. It prints the times and whether all results are equal to
the bit.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from tempfile import mkdtemp

import numpy as np

from toolkit.progress import TqdmProgress
from toolkit.recipes.registry import find_recipe
from toolkit.runs.sweep import SweepPlaces, create_sweep
from toolkit.runs.sweep_run import work_on_sweep
from toolkit.runs.sweep_space import parse_dimension
from toolkit.runs.sweep_table import TrialRow
from toolkit.samples.make import SampleSettings, make_sample

RECIPE = "sensor-3dgs"
SAMPLE = {"flight.frames": 16, "flight.image_width": 240, "flight.image_height": 180}
BASE = {"sift.max_features": 1024, "pairs.method": "spatial", "train.steps": 150, "train.eval_every": 50}
SPACE = ("train.lr_means=4e-5,1.6e-4,6.4e-4", "train.lambda_dssim=0,0.2", "train.sh_degree=0,2")
WORKERS = 2


@contextmanager
def cluster(folder: Path) -> Iterator[str]:
    """Yield the address of a scheduler with two workers in processes of their own."""
    told = folder / "scheduler.json"
    with ExitStack() as stack:

        def start(*arguments: str) -> None:
            process = subprocess.Popen(
                [sys.executable, "-m", "dask", *arguments, "--no-dashboard"], stderr=subprocess.DEVNULL
            )
            stack.callback(process.wait, 30)
            stack.callback(process.terminate)

        start("scheduler", "--host", "127.0.0.1", "--port", "0", "--scheduler-file", str(told))
        while not told.exists() or not told.read_text().strip().endswith("}"):
            time.sleep(0.1)
        address = json.loads(told.read_text())["address"]
        for _ in range(WORKERS):
            start("worker", address, "--nthreads", "1", "--nworkers", "1")
        import distributed

        with distributed.Client(address, set_as_default=False) as client:
            client.wait_for_workers(WORKERS, timeout=60)
        yield address


def swept(town: Path, runs_dir: Path, places: SweepPlaces) -> tuple[list[TrialRow], float]:
    """Return the trials of a sweep, and the seconds that it took."""
    recipe = find_recipe(RECIPE)
    base = recipe.settings_type().replace(BASE)
    space = [parse_dimension(text, "grid", base) for text in SPACE]
    sweep = create_sweep(recipe, town, base, runs_dir, method="grid", space=space, places=places)
    bar = TqdmProgress()
    began = time.perf_counter()
    try:
        return work_on_sweep(sweep, bar), time.perf_counter() - began
    finally:
        bar.close()


def results(runs_dir: Path, row: TrialRow) -> tuple[str, bytes]:
    """Return all measures as text with all digits, and the bytes of the splat."""
    artifacts = runs_dir / row.run / "artifacts"
    metrics = json.loads((artifacts / "result.json").read_text())["metrics"]
    return json.dumps(metrics, sort_keys=True), (artifacts / "splat.ply").read_bytes()


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--work", type=Path, help="folder for flight and runs [a temporary one]")
    work = parser.parse_args().work or Path(mkdtemp(prefix="sweep-"))
    town, bar = work / "town", TqdmProgress()
    if not (town / "sample.json").is_file():
        make_sample(town, SampleSettings().replace(SAMPLE), seed=0, progress=bar)
    bar.close()
    print(f"{os.cpu_count()} cores, load {os.getloadavg()[0]:.1f} before")
    folders = [Path(mkdtemp(prefix=f"{name}-", dir=work)) for name in ("here", "cluster")]
    here, here_seconds = swept(town, folders[0], SweepPlaces(workers=WORKERS, threads=1))
    with cluster(work) as address:
        there, there_seconds = swept(town, folders[1], SweepPlaces(cluster=address, threads=1))
    equal = [results(folders[0], one) == results(folders[1], two) for one, two in zip(here, there, strict=True)]
    values = [row.value for row in here if row.value is not None]
    print(f"{len(here)} runs of {RECIPE}, {BASE['train.steps']} steps, {WORKERS} workers of one thread")
    for where, rows, seconds in (
        ("processes of this machine", here, here_seconds),
        ("Dask cluster", there, there_seconds),
    ):
        print(f"{where:<26} {seconds:6.1f} s, {sum(row.state == 'finished' for row in rows)} finished")
    print(f"measures and splats equal to the bit in {sum(equal)} of {len(equal)}")
    print(f"test PSNR {min(values):.2f} to {max(values):.2f} dB, median {np.median(values):.2f}")
    print(f"load {os.getloadavg()[0]:.1f} after")


if __name__ == "__main__":
    main()
