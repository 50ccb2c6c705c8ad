"""The page is one file that needs nobody else, and shows names as they are written."""

from __future__ import annotations

import base64
import dataclasses
import io
import json
import re
import shutil
import subprocess
from html.parser import HTMLParser
from pathlib import Path

import pytest
from fake_recipe import RECIPE, MakeRun
from PIL import Image

from toolkit.errors import RunError, StageError
from toolkit.progress import ProgressEvent
from toolkit.runs.compare import compare_runs
from toolkit.runs.folder import RunFolder
from toolkit.runs.launch import execute
from toolkit.runs.report_html import write_report

# A name that would do harm where it is not escaped. It has no slash: names may not.
ODD = "<script>alert(1)<b>&'\""


class Page(HTMLParser):
    """Elements, attributes and texts of a page."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.tags: list[str] = []
        self.attributes: list[tuple[str, str, str]] = []
        self.texts: list[str] = []
        self.open: list[str] = []
        self.feed(text)
        self.close()

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append(tag)
        self.attributes += [(tag, name, value or "") for name, value in attrs]
        if tag not in {"img", "input", "meta", "br"}:
            self.open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        assert self.open, f"</{tag}> closes nothing"
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        if not self.open or self.open[-1] not in {"script", "style"}:
            self.texts.append(data)

    def sources(self) -> list[str]:
        return [value for tag, name, value in self.attributes if tag == "img" and name == "src"]


@pytest.fixture
def runs(finished: MakeRun, queued: MakeRun) -> list[RunFolder]:
    failed = queued(name="stopped early", fail_at=20)
    with pytest.raises(StageError):
        execute(failed, recipe=RECIPE)
    return [finished(name=ODD, loop__rate=0.8), finished(name="fast", loop__rate=0.2), failed]


def page_of(runs: list[RunFolder], folder: Path, **options: int) -> str:
    write_report(compare_runs(runs), folder / "page.html", **options)
    return (folder / "page.html").read_text(encoding="utf-8")


def figures_of(text: str) -> dict[str, dict[str, dict[str, object]]]:
    found = re.search(r'<script type="application/json" id="figures">(.*?)</script>', text, re.DOTALL)
    assert found
    figures: dict[str, dict[str, dict[str, object]]] = json.loads(found[1])
    return figures


def test_the_page_is_well_formed_and_loads_nothing(runs: list[RunFolder], tmp_path: Path) -> None:
    page = Page(page_of(runs, tmp_path))
    assert page.open == []
    assert page.tags.count("html") == page.tags.count("title") == page.tags.count("main") == 1
    for tag, name, value in page.attributes:
        if name in {"src", "href", "action", "data", "poster", "srcset"}:
            assert value.startswith("data:image/jpeg;base64,"), (tag, name, value[:60])
    assert "link" not in page.tags
    assert "iframe" not in page.tags
    policy = [value for tag, name, value in page.attributes if tag == "meta" and name == "content"]
    assert any("default-src 'none'" in value for value in policy)
    css = re.findall(r"<style>(.*?)</style>", (tmp_path / "page.html").read_text(), re.DOTALL)
    assert len(css) == 1
    assert "url(" not in css[0]
    assert "@import" not in css[0]


def test_names_are_shown_as_written_and_do_nothing(runs: list[RunFolder], tmp_path: Path) -> None:
    text = page_of(runs, tmp_path)
    page = Page(text)
    assert page.tags.count("script") == 3  # figures, Plotly, the page's own
    assert any(ODD in said for said in page.texts)
    assert ODD not in text
    names = {
        trace["name"]
        for variants in figures_of(text).values()
        for figure in variants.values()
        for trace in figure["data"]
        if "name" in trace
    }
    assert "&lt;script&gt;alert(1)&lt;b&gt;&amp;'\"" in names  # Plotly reads tags in names


def test_pictures_are_embedded_once_each(runs: list[RunFolder], tmp_path: Path) -> None:
    page = Page(page_of(runs, tmp_path))
    sources = page.sources()
    photos = sum(name == "class" and value == "photo" for tag, name, value in page.attributes if tag == "img")
    assert len(sources) == len(set(sources)) == 9  # three photos shared by two runs, and six renders
    assert photos == 6
    assert sum(name == "data-same" for _, name, _ in page.attributes) == 3
    ids = {value for _, name, value in page.attributes if name == "id"}
    assert {value for _, name, value in page.attributes if name == "data-same"} <= ids
    for source in sources:
        picture = Image.open(io.BytesIO(base64.b64decode(source.partition(",")[2])))
        assert picture.size == (48, 32)


def test_wide_pictures_are_scaled_down(runs: list[RunFolder], tmp_path: Path) -> None:
    for source in Page(page_of(runs, tmp_path, picture_width=24)).sources():
        picture = Image.open(io.BytesIO(base64.b64decode(source.partition(",")[2])))
        assert picture.size == (24, 16)


def test_the_worst_pictures_come_first_and_the_rest_is_counted(runs: list[RunFolder], tmp_path: Path) -> None:
    psnr: dict[str, float] = {}
    for run in runs[:2]:
        for view in run.result().test_views:
            psnr[view.name] = min(psnr.get(view.name, 1e9), view.psnr)
    order = sorted(psnr, key=psnr.__getitem__)
    text = page_of(runs, tmp_path)
    places = [text.index(f"<h3>{name}</h3>") for name in order]
    assert places == sorted(places)
    assert "All 3 pictures" in text
    short = page_of(runs, tmp_path, most_views=1)
    assert f"<h3>{order[0]}</h3>" in short
    assert f"<h3>{order[1]}</h3>" not in short
    assert "The 1 worst of 3 pictures" in short


def test_missing_pictures_are_told_in_their_place(runs: list[RunFolder], tmp_path: Path) -> None:
    (runs[0].artifacts / runs[0].result().test_views[0].render).write_bytes(b"no picture")
    assert page_of(runs, tmp_path).count("The pictures of this view are missing.") == 1


def test_curves_times_and_trajectories_are_drawn(runs: list[RunFolder], tmp_path: Path) -> None:
    text = page_of(runs, tmp_path)
    figures = figures_of(text)
    titles = [next(iter(variants.values()))["layout"]["title"]["text"] for variants in figures.values()]
    assert [title for title in titles if title] == ["loss (train)", "total (train)"]
    curves = next(variants for variants in figures.values() if "step" in variants)
    assert set(curves) == {"step", "time"}
    assert len(curves["step"]["data"]) == 3  # the failed run has a curve too
    kinds = {trace["type"] for variants in figures.values() for f in variants.values() for trace in f["data"]}
    assert kinds == {"scatter", "bar", "scatter3d"}
    assert "Aligned to &lt;script&gt;" in text  # no reference: to the first run
    for key in figures:
        assert f'data-figure="{key}"' in text


def test_warnings_settings_and_states_are_on_the_page(runs: list[RunFolder], tmp_path: Path) -> None:
    said = " ".join(Page(page_of(runs, tmp_path)).texts)
    for part in (
        "stopped early is failed and has no result yet. The fake recipe fails here; found step 20.",
        "loop.rate",
        "fail_at",
        "poses.sim3.ate",
        "lower is better",
        "reused",
        "Log of fast",
    ):
        assert part in said


def test_the_best_value_is_marked(runs: list[RunFolder], tmp_path: Path) -> None:
    text = page_of(runs, tmp_path)
    # The bar is as long as the value by the largest of the row: 0.2 of 0.8, and of the other all of it.
    assert '<td class="best" title="best" style="--run:#f59e0b;--part:0.250"><b>0.2000</b></td>' in text
    assert '<td style="--run:#3b82f6;--part:1.000">0.8000</td>' in text


def test_one_run_alone_makes_its_report(runs: list[RunFolder], tmp_path: Path) -> None:
    text = page_of(runs[1:2], tmp_path)
    assert "<h1>fast</h1>" in text
    assert "Report of a run" in text
    assert "Settings that differ" not in text
    assert 'class="best"' not in text


def test_a_run_that_did_not_begin_has_a_page_too(queued: MakeRun, tmp_path: Path) -> None:
    text = page_of([queued(name="waiting")], tmp_path)
    assert Page(text).open == []
    assert "waiting is queued and has no result yet." in text
    assert figures_of(text) == {}


def test_damaged_curves_and_trajectories_are_remarks(runs: list[RunFolder], tmp_path: Path) -> None:
    with runs[0].metrics_file.open("a") as file:
        file.write("what\n")
    runs[1].metrics_file.write_text("other\n")
    text = page_of(runs[:2], tmp_path)
    assert "1 damaged lines of metrics.csv were left out." in text
    assert "holds no measurements of a run" in text
    comparison = compare_runs(runs[:2])
    runs[0].trajectory_file.write_text("{}")
    write_report(comparison, tmp_path / "page.html")
    assert "holds no trajectories" in (tmp_path / "page.html").read_text()


def test_long_reports_are_cut_with_a_word_about_it(runs: list[RunFolder], tmp_path: Path) -> None:
    content = json.loads(runs[1].result_file.read_text())
    content["reports"]["long"] = list(range(20000))
    runs[1].result_file.write_text(json.dumps(content))
    assert f"… cut here; all of it is in {runs[1].result_file}" in page_of(runs[1:2], tmp_path)


def test_measures_that_were_not_finite_do_not_break_the_page(finished: MakeRun, tmp_path: Path) -> None:
    run = finished(name="odd")
    content = json.loads(run.result_file.read_text())
    content["test_views"][0]["psnr"] = None
    run.result_file.write_text(json.dumps(content))
    with run.metrics_file.open("a") as file:
        file.write("9,train,31,loss,nan\n9,train,32,loss,inf\n")
    text = page_of([run], tmp_path)
    assert "PSNR –" in text
    assert figures_of(text)


def test_progress_is_told_picture_by_picture(runs: list[RunFolder], tmp_path: Path) -> None:
    events: list[ProgressEvent] = []
    write_report(compare_runs(runs), tmp_path / "page.html", progress=events.append)
    assert [(event.stage, event.done, event.total) for event in events] == [
        ("report.pictures", done, 3) for done in range(4)
    ]


def test_a_folder_that_refuses_is_told(finished: MakeRun, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    comparison = compare_runs([finished()])

    def refuse(self: Path, *args: object, **kwargs: object) -> None:
        raise PermissionError(13, "Permission denied", str(self))

    monkeypatch.setattr(Path, "write_text", refuse)
    with pytest.raises(RunError, match=r"Not allowed while writing .*page\.html"):
        write_report(comparison, tmp_path / "page.html")


def test_runs_are_not_changed_by_their_page(runs: list[RunFolder], tmp_path: Path) -> None:
    before = {path: path.read_bytes() for run in runs for path in run.path.rglob("*") if path.is_file()}
    page_of(runs, tmp_path)
    assert before == {path: path.read_bytes() for run in runs for path in run.path.rglob("*") if path.is_file()}
    assert all(dataclasses.is_dataclass(run) for run in runs)


@pytest.mark.slow
def test_a_browser_draws_the_page_without_an_error(runs: list[RunFolder], tmp_path: Path) -> None:
    browser = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
    if browser is None:
        pytest.skip("no Chromium is installed: apt-get install chromium")
    page_of(runs, tmp_path)
    command = [
        browser,
        "--headless",
        "--no-sandbox",
        "--disable-gpu",
        f"--user-data-dir={tmp_path / 'browser'}",
        "--enable-logging=stderr",
        "--virtual-time-budget=8000",
        "--dump-dom",
        (tmp_path / "page.html").as_uri(),
    ]
    done = subprocess.run(command, capture_output=True, text=True, timeout=120, check=False)
    assert done.returncode == 0, done.stderr
    errors = [line for line in done.stderr.splitlines() if "CONSOLE" in line and "Error" in line]
    assert errors == []
    drawn = done.stdout.count("js-plotly-plot")
    assert drawn >= len(figures_of((tmp_path / "page.html").read_text()))
    # The script has copied the shared photos into their places.
    shared = re.findall(r"<img[^>]*data-same[^>]*>", done.stdout)
    assert len(shared) == 3
    assert all("src=" in tag for tag in shared)
