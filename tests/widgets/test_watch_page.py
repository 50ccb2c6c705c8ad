"""One run is followed by what its folder says."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

import numpy as np
import panel as pn
import pytest
from fake_recipe import RECIPE, MakeRun
from PIL import Image

from toolkit.files import write_json, write_text
from toolkit.recipes.live_view import LIVE, PHOTO, POSES, RENDER, VIEW
from toolkit.runs import stop
from toolkit.runs.curve_tail import LiveCurve
from toolkit.runs.curves import CurveWriter
from toolkit.runs.folder import RunFolder
from toolkit.runs.launch import execute
from toolkit.runs.process import ProcessMark
from toolkit.runs.queue import waiting_runs
from toolkit.runs.status import RunStatus, utc_now, write_status
from toolkit.widgets.live_chart import LiveChart
from toolkit.widgets.run_head import Pace
from toolkit.widgets.watch_page import WatchPage


@pytest.fixture(autouse=True)
def alone(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(stop, "ensure_worker", lambda runs_dir: True)


def said(page: WatchPage) -> str:
    """Return all HTML that can be seen."""
    return "\n".join(visible_html(page.__panel__()))


def visible_html(part: pn.viewable.Viewable) -> list[str]:
    if not part.visible:
        return []
    if isinstance(part, pn.pane.HTML):
        return [part.object] if part.object else []
    inner = list(part) if isinstance(part, pn.layout.ListLike) else []
    return [text for each in inner for text in visible_html(each)]


def find(page: WatchPage, label: str) -> Any:
    return next(each for each in page.__panel__().select(pn.widgets.Widget) if each.label == label)


def works(run: RunFolder, done: int, total: int = 100, *, moment: str = "") -> None:
    """Write what a process that is at work would: this one."""
    status = RunStatus(
        "running",
        stage="splat.train",
        done=done,
        total=total,
        started=utc_now(),
        heartbeat=moment or utc_now(),
        process=ProcessMark.current(),
    )
    write_status(run.status_file, status)


def measured(run: RunFolder, steps: range, name: str = "loss") -> None:
    writer = CurveWriter(run.metrics_file)
    for step in steps:
        writer.write(0.5 * step, "splat.train", step, {name: 1.0 / step})
    writer.close()


def test_the_newest_run_is_shown_until_one_is_chosen(runs_dir: Path, queued: MakeRun, finished: MakeRun) -> None:
    page = WatchPage(runs_dir)
    assert "There are no runs yet." in said(page)
    run = queued(name="mine")
    page.refresh()
    assert page.selected == run.id
    assert "It waits for its turn." in said(page)
    # Once something is shown it stays, whatever comes.
    other = finished(name="later")
    page.refresh()
    assert page.selected == run.id
    find(page, "Run").value = other.id
    assert page.selected == other.id
    find(page, "Run").value = ""
    page.refresh()
    assert page.selected == ""
    assert "Choose a run to follow it." in said(page)


def test_one_that_works_goes_before_newer_ones(runs_dir: Path, queued: MakeRun) -> None:
    busy, _ = queued(name="works"), queued(name="waits")
    works(busy, 1)
    assert WatchPage(runs_dir).selected == busy.id


def test_a_finished_run_is_shown_whole(runs_dir: Path, finished: MakeRun, odd_name: str) -> None:
    run = finished(name=odd_name)
    page = WatchPage(runs_dir)
    page.selected = run.id
    text = said(page)
    assert "badge finished" in text
    assert "&lt;script&gt;" in text
    assert "<script>" not in text
    assert "finished after" in text  # the log
    assert [name for _, name in page.curves.charts] == ["loss", "total"]
    assert len(page.curves.charts["train", "loss"].points["x"]) == 30
    assert not find(page, "Cancel").visible
    assert not find(page, "Resume").visible


def test_a_finished_run_is_opened_in_other_tabs(runs_dir: Path, finished: MakeRun) -> None:
    run = finished()
    opened: list[tuple[str, str]] = []
    page = WatchPage(runs_dir, show=lambda tab, run_id: opened.append((tab, run_id)))
    page.selected = run.id
    find(page, "Compare").clicks += 1
    assert not find(page, "View splat").visible  # the fake recipe makes none
    run.splat_file.write_bytes(b"")
    page.refresh()
    assert find(page, "View splat").visible
    find(page, "View splat").clicks += 1
    assert opened == [("compare", run.id), ("view", run.id)]


def test_a_working_run_is_followed(runs_dir: Path, queued: MakeRun) -> None:
    run = queued()
    works(run, 10)
    measured(run, range(1, 11))
    page = WatchPage(runs_dir)
    page.selected = run.id
    chart = page.curves.charts["splat.train", "loss"]
    assert chart.points["x"] == list(range(1, 11))
    assert "splat.train: 10 of 100" in said(page)
    # Half a second a step, by its curve.
    assert "about 45 s left of this stage" in said(page)
    assert find(page, "Cancel").visible
    works(run, 20)
    measured(run, range(11, 21))
    page.refresh()
    assert page.curves.charts["splat.train", "loss"] is chart
    assert chart.added["x"] == list(range(11, 21))
    assert chart.points["x"] == list(range(1, 11))  # nothing is sent twice
    assert "about 40 s left of this stage" in said(page)


def test_nothing_is_read_again_while_nothing_changes(
    runs_dir: Path, queued: MakeRun, monkeypatch: pytest.MonkeyPatch
) -> None:
    run = queued()
    works(run, 10)
    measured(run, range(1, 11))
    page = WatchPage(runs_dir)
    page.selected = run.id
    serial = page.curves.charts["splat.train", "loss"].added["serial"]
    monkeypatch.setattr(Path, "open", lambda *args, **kwargs: pytest.fail("a file was opened"))
    page.curves.refresh()
    page.scene.refresh()
    page.log.refresh()
    assert page.curves.charts["splat.train", "loss"].added["serial"] == serial


def test_the_psnr_of_a_test_view_has_one_chart(runs_dir: Path, queued: MakeRun) -> None:
    run = queued()
    works(run, 10)
    measured(run, range(5, 11, 5), "psnr_test")
    page = WatchPage(runs_dir)
    page.selected = run.id
    assert list(page.curves.charts) == [("splat.train", "psnr_test")]
    measured(run, range(1, 11), "psnr_live")  # the same at more steps
    page.refresh()
    assert list(page.curves.charts) == [("splat.train", "psnr_live")]
    assert [name for name, _ in page.curves.latest()] == ["psnr_live"]
    assert said(page).count("PSNR of a test view") == 1


def test_the_logarithmic_axis_is_for_losses(runs_dir: Path, finished: MakeRun) -> None:
    page = WatchPage(runs_dir)
    page.selected = finished().id
    find(page, "Logarithmic loss").value = True
    assert page.curves.charts["train", "loss"].log
    assert not page.curves.charts["train", "total"].log


def test_picture_and_paths_are_shown_as_they_come(runs_dir: Path, queued: MakeRun) -> None:
    run = queued()
    works(run, 10)
    page = WatchPage(runs_dir)
    page.selected = run.id
    assert "Latest render" not in said(page)
    live = run.artifacts / LIVE
    live.mkdir()
    for name, level in ((PHOTO, 40), (RENDER, 90)):
        Image.fromarray(np.full((8, 12, 3), level, np.uint8)).save(live / name)
    write_json(live / VIEW, {"name": "<b>a.png", "step": 10, "steps": 100, "psnr": 17.25})
    rows = [{"name": f"{i}.png", "centre": [i, 0, 0], "cam_from_world_wxyz": [1, 0, 0, 0]} for i in range(4)]
    write_json(live / POSES, {"step": 10, "found": rows, "reference": rows})
    page.refresh()
    text = said(page)
    assert "Render at step 10 of 100, 17.25 dB" in text
    assert "&lt;b&gt;a.png" in text
    assert text.count("data:image/jpeg;base64,") == 2
    (paths,) = [pane for pane in page.__panel__().select(pn.pane.Plotly) if pane.visible]
    assert [trace.name for trace in paths.object.data if trace.name] == ["start", "refined"]
    moved = [{**row, "centre": [row["centre"][0], 1, 0]} for row in rows]
    write_json(live / POSES, {"step": 20, "found": moved, "reference": rows})
    page.refresh()
    (refined,) = [trace for trace in paths.object.data if trace.name == "refined"]
    assert list(refined.y) == [1, 1, 1, 1]


def test_buttons_stop_a_run_and_let_it_go_on(runs_dir: Path, queued: MakeRun, failed: RunFolder) -> None:
    waits = queued(name="waits")
    page = WatchPage(runs_dir)
    page.selected = waits.id
    find(page, "Cancel").clicks += 1
    assert waits.status().state == "cancelled"
    assert f"Run {waits.id} is cancelled." in said(page)
    page.selected = failed.id
    assert "The fake recipe fails here; found step 20." in said(page)
    find(page, "Resume").clicks += 1
    assert waiting_runs(runs_dir) == [failed]
    failed.status_file.write_text("{")
    find(page, "Resume").clicks += 1
    assert "Cannot read" in said(page)


def test_a_run_that_is_deleted_or_damaged_while_it_is_shown_is_told(
    runs_dir: Path, finished: MakeRun, tmp_path: Path
) -> None:
    run = finished()
    page = WatchPage(runs_dir)
    page.selected = run.id
    kept = run.status_file.read_text()
    run.status_file.write_text("{")
    write_text(run.artifacts / LIVE / VIEW, "{")
    page.refresh()
    assert said(page).count("Cannot read") == 2
    run.status_file.write_text(kept)
    run.path.rename(tmp_path / "away")
    page.refresh()
    assert f"Run {run.id} was deleted." in said(page)
    assert not find(page, "Cancel").visible
    (tmp_path / "away").rename(run.path)
    page.refresh()
    assert "badge finished" in said(page)


@pytest.mark.parametrize("odd", ["../secret", "/etc", "20990101-000000-fake-0000", "<img src=x>"])
def test_a_run_that_is_not_there_is_told_as_text(runs_dir: Path, odd: str) -> None:
    page = WatchPage(runs_dir)
    page.selected = odd
    assert "There is no run" in said(page)
    assert "<img" not in said(page)


def test_a_run_whose_process_died_is_told_and_can_go_on(runs_dir: Path, queued: MakeRun) -> None:
    run = queued()
    write_status(run.status_file, RunStatus("running", stage="train", heartbeat="2020-01-01T00:00:00+00:00"))
    page = WatchPage(runs_dir)
    page.selected = run.id
    assert "badge interrupted" in said(page)
    assert "no sign of process unknown" in said(page)
    assert find(page, "Resume").visible
    assert not find(page, "Cancel").visible


def test_time_left_by_the_status_alone() -> None:
    pace = Pace()

    def at(second: int, done: int, stage: str = "match") -> RunStatus:
        moment = f"2026-01-01T00:00:{second:02d}.000+00:00"
        return RunStatus("running", stage=stage, done=done, total=100, heartbeat=moment)

    assert pace.left(at(0, 0)) is None
    assert pace.left(at(10, 20)) == pytest.approx(40.0, rel=1e-12)
    assert pace.left(at(20, 60)) == pytest.approx(40 / 3, rel=1e-12)
    assert pace.left(at(20, 60), seconds_a_step=2.0) == 80.0
    assert pace.left(at(30, 0, "train")) is None  # another stage begins anew
    assert pace.left(RunStatus("finished", stage="train", done=1, total=2, heartbeat=utc_now())) is None


def test_a_chart_sends_all_where_what_was_drawn_changed_and_what_is_new_else() -> None:
    chart, curve = LiveChart(title="Loss"), LiveCurve("train", "loss", most=4)
    for step in (1, 2):
        curve.add(step, step, float("nan") if step == 2 else 0.5)
    chart.draw(curve)
    assert (chart.points["x"], chart.points["y"]) == ([1, 2], [0.5, None])
    curve.add(3, 3, 0.25)
    chart.draw(curve)
    assert (chart.added["x"], chart.added["y"]) == ([3], [0.25])
    assert chart.added["serial"] > chart.points["serial"]
    # A view that is opened late asks for all of it.
    chart._handle_msg("whole")
    assert chart.points["x"] == [1, 2, 3]
    assert chart.points["serial"] > chart.added["serial"]
    for step in (4, 5):
        curve.add(step, step, 0.1)
    chart.draw(curve)
    assert chart.points["x"] == [1, 3, 5]


def test_the_log_is_read_from_its_end(runs_dir: Path, queued: MakeRun) -> None:
    run = queued()
    run.log_file.write_text("".join(f"line {number} <b>\n" for number in range(5000)))
    page = WatchPage(runs_dir)
    page.selected = run.id
    text = said(page)
    assert "line 4999 &lt;b&gt;" in text
    assert "line 1 &lt;b&gt;" not in text
    assert "<b>\n" not in text


def test_a_run_goes_on_while_it_is_watched(runs_dir: Path, queued: MakeRun) -> None:
    """What the page shows after a run of its own is what the run wrote, whenever it looked."""
    run = queued(loop__steps=60)
    page = WatchPage(runs_dir)
    page.selected = run.id
    looked = []

    def look(event: Any) -> None:
        if event.stage == "train" and event.done % 20 == 0:
            page.refresh()
            looked.append(page.curves.latest()[0][1])

    begun = time.monotonic()
    execute(run, look, recipe=RECIPE)
    page.refresh()
    assert looked == sorted(looked, reverse=True)  # the loss falls from look to look
    assert len(set(looked)) == 3
    assert "badge finished" in said(page)
    assert time.monotonic() - begun < 30
