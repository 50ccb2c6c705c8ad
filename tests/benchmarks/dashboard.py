"""Measures the dashboard with thousands of run folders: opening, filtering, memory, five browsers at once.

``python tests/benchmarks/dashboard.py [--runs 2000] [--folder runs/bench-dashboard] [--report-kb 20]`` on a machine
with nothing else to do and Chromium; prints a table in Markdown. The folders are made once and taken again.
"""

from __future__ import annotations

import argparse
import asyncio
import shutil
import socket
import statistics
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from pathlib import Path

import numpy as np
from PIL import Image
from playwright.async_api import Browser, Page, async_playwright

from toolkit.files import write_json
from toolkit.progress import TqdmProgress, track
from toolkit.recipes.registry import find_recipe
from toolkit.runs.catalogue import FOLDER, Catalogue
from toolkit.runs.curves import CurveWriter
from toolkit.runs.folder import RunFolder, make_folder
from toolkit.runs.machine import describe_code, describe_machine, describe_threads
from toolkit.runs.notes import RunNotes, write_notes
from toolkit.runs.record import RunRecord
from toolkit.runs.status import RunStatus, utc_now, write_status

RECIPES = ("colmap-3dgs", "sensor-3dgs", "sensor-fused")
#: Test pictures of a run; only the two newest runs have the files, the others their measures.
VIEWS = 24
DAMAGED = 2
BROWSERS = 5
REPEATS = 7
_CHROMIUM = ["--no-sandbox", "--disable-gpu", "--enable-unsafe-swiftshader"]
# The table lies in shadow roots: it is looked for once.
_FIND_TABLE = """
() => {
  const look = (root) => {
    for (const element of root.querySelectorAll("*")) {
      if (element.classList.contains("tabulator-table")) return element;
      const found = element.shadowRoot && look(element.shadowRoot);
      if (found) return found;
    }
    return null;
  };
  window.foundTable = look(document);
}
"""
_ROWS_ARE = """
([text, count]) => {
  const rows = window.foundTable.querySelectorAll(".tabulator-row");
  return count > 1 ? rows.length >= count : rows.length === 1 && rows[0].textContent.includes(text);
}
"""


@dataclass(frozen=True, slots=True)
class Visit:
    """Seconds that one browser waited: for the list, for the comparison, and for each filter."""

    list: float
    comparison: float
    filters: list[float]


def make_runs(folder: Path, count: int, report_kb: int) -> None:
    """Make ``count`` finished runs, the last two with pictures, two others damaged."""
    code, machine, threads = describe_code(), describe_machine("cpu"), describe_threads()
    began = datetime(2026, 1, 1, tzinfo=UTC)
    bar = TqdmProgress()
    for number in track(range(count), "make runs", bar):
        recipe = RECIPES[number % len(RECIPES)]
        created = began + timedelta(minutes=number)
        run_id = f"{created:%Y%m%d-%H%M%S}-{recipe}-{number % 65536:04x}"
        if (folder / run_id).is_dir():
            continue
        settings = find_recipe(recipe).settings_type().to_dict()
        record = RunRecord(
            recipe=recipe,
            settings=settings,
            seed=number,
            device="cpu",
            data=f"/data/flight-{number % 7}",
            data_fingerprint=f"{number % 7:064x}",
            name=f"run {number:05d}",
            created=created.isoformat(timespec="milliseconds"),
            code=code,
            machine=machine,
            threads=threads,
        )
        fill(make_folder(folder, run_id, record), number, report_kb, pictures=number >= count - 2)
        if number < DAMAGED:
            (folder / run_id / "run.json").write_text("{")
    bar.close()


def fill(run: RunFolder, number: int, report_kb: int, *, pictures: bool) -> None:
    """Write what a finished run leaves behind."""
    rng = np.random.default_rng(number)
    psnr = rng.uniform(18, 30, VIEWS)
    views = []
    for i in range(VIEWS):
        names = {"photo": f"test/{i:03d}_photo.png", "render": f"test/{i:03d}_render.png"}
        views.append({"name": f"frame_{i:05d}.jpg", **names, "psnr": psnr[i], "ssim": 0.8, "lpips": None})
        if pictures:
            (run.artifacts / "test").mkdir(exist_ok=True)
            photo = rng.integers(0, 255, (20, 30, 3), dtype=np.uint8)
            for name, noise in ((names["photo"], 0), (names["render"], 20)):
                picture = np.clip(photo + rng.integers(0, noise + 1, photo.shape), 0, 255).astype(np.uint8)
                large = Image.fromarray(picture).resize((960, 640), Image.Resampling.BICUBIC)
                large.save(run.artifacts / name)
    metrics = {"test.psnr": float(psnr.mean()), "test.ssim": 0.8, "test.lpips_alex": None, "poses.sim3.pos": 0.05}
    metrics |= {f"more.measure_{i:02d}": float(rng.normal()) for i in range(36)}
    times = [{"name": name, "seconds": float(rng.uniform(1, 90)), "reused": False} for name in ("sfm", "train")]
    reports = {"train": {"numbers": rng.normal(size=report_kb * 1024 // 22).tolist()}}
    write_json(run.result_file, {"metrics": metrics, "times": times, "reports": reports, "test_views": views})
    curves = CurveWriter(run.metrics_file)
    for step in range(0, 1000, 10):
        curves.write(
            0.02 * step, "splat.train", step, {"loss": float(np.exp(-step / 400)), "psnr": 20 + step / 100}
        )
    curves.close()
    if number % 50 == 0:
        write_notes(run, RunNotes(("reference",), "One of every fifty."))
    write_status(run.status_file, RunStatus("finished", "train", 1000, 1000, heartbeat=utc_now()))


def catalogue_seconds(folder: Path) -> tuple[float, float, float]:
    """Return seconds of the first reading, of one from the index, and of a look that finds nothing new."""
    shutil.rmtree(folder / FOLDER, ignore_errors=True)
    seconds = []
    for _ in range(2):
        catalogue = Catalogue(folder)
        begin = time.perf_counter()
        catalogue.refresh()
        seconds.append(time.perf_counter() - begin)
    begin = time.perf_counter()
    catalogue.refresh()
    return seconds[0], seconds[1], time.perf_counter() - begin


@contextmanager
def served(folder: Path) -> Iterator[tuple[str, int]]:
    """Serve the runs in a process of its own; yield address and process number."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    command = [sys.executable, "-m", "toolkit", "dashboard", "--runs", str(folder), "--port", str(port)]
    command += ["--data", str(folder / ".data")]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as server:
        try:
            assert server.stdout is not None
            server.stdout.readline()
            yield f"http://localhost:{port}/", server.pid
        finally:
            server.terminate()
            server.communicate(timeout=20)


def memory(pid: int, name: str) -> float:
    """Return ``VmRSS`` or ``VmHWM`` (the most so far) of a process in MB."""
    for line in Path(f"/proc/{pid}/status").read_text(encoding="ascii").splitlines():
        if line.startswith(f"{name}:"):
            return int(line.split()[1]) / 1000
    raise SystemExit(f"The system does not tell {name} of process {pid}")


async def visit(page: Page, address: str, count: int) -> Visit:
    """Open the page and filter it as a person would; times are those of the browser's own clock."""
    begin = time.perf_counter()
    await page.goto(address, wait_until="commit")
    await page.locator(".tabulator-row").first.wait_for(timeout=120_000)
    of_list = time.perf_counter() - begin
    await page.locator("article.view img").first.wait_for(timeout=120_000)
    of_comparison = time.perf_counter() - begin
    await page.wait_for_timeout(2000)
    await page.evaluate(_FIND_TABLE)
    box = page.get_by_label("Filter", exact=True)
    filters = []
    for number in range(REPEATS):
        name = f"run {(number * 271 + 17) % count:05d}"
        begin = time.perf_counter()
        await box.fill(name)
        await _wait_for_rows(page, name, 1)
        filters.append(time.perf_counter() - begin)
        begin = time.perf_counter()
        await box.fill("")
        await _wait_for_rows(page, "", 25)
        filters.append(time.perf_counter() - begin)
    return Visit(of_list, of_comparison, filters)


async def _wait_for_rows(page: Page, text: str, count: int) -> None:
    await page.wait_for_function(_ROWS_ARE, arg=[text, min(count, 10)], polling=10, timeout=60_000)


async def browsers(address: str, pid: int, count: int) -> list[str]:
    """Return lines of the table: one browser, the same with filled caches, and several at once."""
    lines = []
    program = shutil.which("chromium") or shutil.which("chromium-browser")
    async with async_playwright() as playwright:

        async def opened() -> Browser:
            return await playwright.chromium.launch(executable_path=program, args=_CHROMIUM)

        one = await opened()
        context = await one.new_context(viewport={"width": 1440, "height": 900})
        for what in ("first visitor of a new server, new browser", "the same browser again"):
            page = await context.new_page()
            lines += told(what, [await visit(page, address, count)], pid)
            await page.close()
        await one.close()
        lines.append(await all_tabs(await opened(), address, pid))
        several = [await opened() for _ in range(BROWSERS)]
        pages = [await browser.new_page(viewport={"width": 1440, "height": 900}) for browser in several]
        visits = await asyncio.gather(*(visit(page, address, count) for page in pages))
        lines += told(f"{BROWSERS} new browsers at once", list(visits), pid)
        for browser in several:
            await browser.close()
    return lines


async def all_tabs(browser: Browser, address: str, pid: int) -> str:
    """Return the line of the table for a visitor who opens every tab."""
    page = await browser.new_page(viewport={"width": 1440, "height": 900})
    await page.goto(address)
    for name in ("Data", "Run", "Watch", "View", "Sweep", "Compare"):
        await page.get_by_text(name, exact=True).first.click()
        await page.wait_for_timeout(6000)
    line = f"| every tab opened | | | | {memory(pid, 'VmRSS'):.0f} | {memory(pid, 'VmHWM'):.0f} |"
    await browser.close()
    return line


def told(what: str, visits: list[Visit], pid: int) -> list[str]:
    """Return one line of the table."""
    filters = [seconds for each in visits for seconds in each.filters]
    lists, comparisons = [each.list for each in visits], [each.comparison for each in visits]
    return [
        f"| {what} | {statistics.median(lists):.2f} ({max(lists):.2f}) | "
        f"{statistics.median(comparisons):.2f} ({max(comparisons):.2f}) | "
        f"{statistics.median(filters):.3f} ({max(filters):.3f}) | {memory(pid, 'VmRSS'):.0f} | "
        f"{memory(pid, 'VmHWM'):.0f} |"
    ]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--runs", type=int, default=2000)
    parser.add_argument("--folder", type=Path, default=Path("runs/bench-dashboard"))
    parser.add_argument("--report-kb", type=int, default=20, help="size of each run's stage reports")
    options = parser.parse_args()
    make_runs(options.folder, options.runs, options.report_kb)
    first, again, look = catalogue_seconds(options.folder)
    print(f"{options.runs} runs, {DAMAGED} of them damaged, reports of {options.report_kb} kB each.\n")
    print("| reading all runs | seconds |\n|---|---|")
    print(f"| without an index | {first:.2f} |\n| from the index | {again:.2f} |\n| nothing new | {look:.3f} |\n")
    print("Seconds until they are in the browser, medians with the longest in brackets; server memory in MB.\n")
    print("| | list | comparison | filter | memory | most |\n|---|---|---|---|---|---|")
    with served(options.folder) as (address, pid):
        for line in asyncio.run(browsers(address, pid, options.runs)):
            print(line, flush=True)


if __name__ == "__main__":
    main()
