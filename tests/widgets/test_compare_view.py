"""Chosen runs are shown side by side with what the report page computes."""

from __future__ import annotations

import dataclasses
import json
import os
from pathlib import Path

import panel as pn
import pytest
from fake_recipe import RECIPE, MakeRun
from shapes import ball

from toolkit.runs.folder import RunFolder
from toolkit.runs.launch import execute
from toolkit.runs.process import ProcessMark
from toolkit.runs.status import RunStatus, utc_now, write_status
from toolkit.scene.mesh_files import write_mesh
from toolkit.widgets.compare_view import CompareView
from toolkit.widgets.pictures import PictureCard

# Panel still says `inplace`, which the newest pandas wishes away.
pytestmark = pytest.mark.filterwarnings(r"ignore:The inplace keyword in DataFrame\.\w+ is deprecated")


def shown(view: CompareView) -> str:
    """Return all HTML that can be seen."""
    return "\n".join(pane.object for pane in view.__panel__().select(pn.pane.HTML) if pane.visible)


def figures(view: CompareView) -> list[dict[str, object]]:
    """Return all figures that can be seen, from top to bottom."""
    panes = view.__panel__().select(pn.pane.Plotly)
    return [json.loads(pane.object.to_json()) for pane in panes if pane.visible]


def card(view: CompareView) -> str:
    content: str = view.__panel__().select(PictureCard)[0].content
    return content


def compared(*runs: RunFolder) -> CompareView:
    view = CompareView()
    view.compare(runs)
    return view


def test_measures_settings_and_states_stand_side_by_side(pair: list[RunFolder], failed: RunFolder) -> None:
    text = shown(compared(*pair, failed))
    assert '<td class="best" title="best" style="--run:#f59e0b;--part:0.250"><b>0.2000</b></td>' in text
    for part in (
        "loop.rate",
        "fail_at",
        "poses.sim3.ate",
        "lower is better",
        "stopped early is failed and has no result yet. The fake recipe fails here; found step 20.",
        "Settings of fast",
        "reused",
    ):
        assert part in text


def test_names_are_escaped_wherever_they_stand(pair: list[RunFolder], odd_name: str) -> None:
    view = compared(*pair)
    for text in (shown(view), card(view)):
        assert odd_name not in text
        assert "<script" not in text
        assert "<img src=x" not in text
        assert "&lt;script&gt;window.harm=1&lt;img src=x" in text
    for figure in figures(view):
        for trace in figure["data"]:
            assert "<" not in trace.get("name", "")


def test_curves_paths_times_and_views_are_drawn(pair: list[RunFolder]) -> None:
    view = compared(*pair)
    drawn = figures(view)
    kinds = {trace["type"] for figure in drawn for trace in figure["data"]}
    assert kinds == {"scatter", "bar", "scatter3d"}
    assert [curve.name for curve in view.curves] == ["loss", "total"]
    assert len(drawn) == 5  # two curves, PSNR by picture, paths, times
    assert "Aligned to " in shown(view)


def test_curves_are_drawn_over_time_when_asked(pair: list[RunFolder]) -> None:
    view = compared(*pair)
    axis = next(
        group for group in view.__panel__().select(pn.widgets.RadioButtonGroup) if "time" in group.options.values()
    )
    axis.value = "time"
    assert json.dumps(figures(view)).count('"working time in seconds"') == 2


def test_the_worst_picture_comes_first_and_another_can_be_picked(pair: list[RunFolder]) -> None:
    psnr: dict[str, float] = {}
    for run in pair:
        for test in run.result().test_views:
            psnr[test.name] = min(psnr.get(test.name, 1e9), test.psnr)
    order = sorted(psnr, key=psnr.__getitem__)
    view = compared(*pair)
    assert view.view == order[0]
    assert f"<h3>{order[0]}</h3>" in card(view)
    view.pick(order[1])
    assert f"<h3>{order[1]}</h3>" in card(view)
    assert f"<h3>{order[0]}</h3>" not in card(view)
    view.pick("../../secret.png")
    assert view.view == order[1]
    choice = view.__panel__().select(pn.widgets.Select)[0]
    assert list(choice.options.values()) == order
    assert choice.value == order[1]


def test_pictures_are_embedded_and_name_no_file(pair: list[RunFolder], runs_dir: Path) -> None:
    content = card(compared(*pair))
    assert content.count("data:image/jpeg;base64,") == 5  # a photo that two runs share, two renders, two error maps
    assert str(runs_dir) not in content


def test_the_picture_stays_when_another_run_is_chosen(pair: list[RunFolder]) -> None:
    view = compared(pair[0])
    view.pick("photo_4.png")
    view.compare(pair)
    assert view.view == "photo_4.png"


def test_runs_without_a_result_show_what_there_is(queued: MakeRun, failed: RunFolder) -> None:
    view = compared(queued(name="waiting"), failed)
    assert view.view == ""
    assert card(view) == ""
    assert [curve.name for curve in view.curves] == ["loss", "total"]
    assert "waiting is queued and has no result yet." in shown(view)
    assert "Test pictures" not in "".join(
        pane.object for column in view.__panel__() if column.visible for pane in column.select(pn.pane.HTML)
    )


def test_a_running_run_grows(queued: MakeRun) -> None:
    run = queued(name="at work")
    execute(run, recipe=RECIPE)
    run.result_file.rename(run.result_file.with_suffix(".later"))
    mark, now = ProcessMark.current(), utc_now()
    write_status(run.status_file, RunStatus("running", "train", 10, 30, "", now, now, "", mark))
    lines = run.metrics_file.read_text().splitlines(keepends=True)
    run.metrics_file.write_text("".join(lines[:11]))
    view = compared(run)
    assert len(view.curves[0].by_axis["step"].data[0].x) == 5
    assert "train 10 of 30" in shown(view)
    assert not view.refresh()
    run.metrics_file.write_text("".join(lines[:21]))
    assert view.refresh()
    assert len(view.curves[0].by_axis["step"].data[0].x) == 10
    run.result_file.with_suffix(".later").rename(run.result_file)
    write_status(run.status_file, dataclasses.replace(run.status(), state="finished"))
    assert view.refresh()
    assert view.view != ""
    assert "test.psnr" in shown(view)


def test_a_run_whose_process_died_is_told_without_a_change_of_its_files(queued: MakeRun) -> None:
    run = queued(name="at work")
    mark, now = ProcessMark.current(), utc_now()
    write_status(run.status_file, RunStatus("running", "train", 10, 30, "", now, now, "", mark))
    view = compared(run)
    assert 'class="badge running"' in shown(view)
    gone = dataclasses.replace(mark, pid=2**22 - 1)
    before = run.status_file.stat()
    write_status(run.status_file, dataclasses.replace(run.status(), process=gone))
    os.utime(run.status_file, ns=(before.st_atime_ns, before.st_mtime_ns))
    assert view.refresh()
    assert 'class="badge interrupted"' in shown(view)


@pytest.mark.parametrize("file", ["record_file", "status_file", "result_file", "trajectory_file"])
def test_a_damaged_run_is_named_and_the_others_are_shown(pair: list[RunFolder], file: str) -> None:
    getattr(pair[0], file).write_text("[]")
    view = compared(*pair)
    assert f"{pair[0].id} cannot be shown: " in shown(view)
    assert view.comparison is not None
    assert [item.label for item in view.comparison.runs] == ["fast"]


def test_a_run_that_was_removed_is_named(pair: list[RunFolder], runs_dir: Path) -> None:
    view = compared(*pair)
    pair[0].path.rename(runs_dir.parent / "elsewhere")
    assert view.refresh()
    assert f"{pair[0].id} cannot be shown: " in shown(view)


def test_nothing_chosen_shows_nothing(pair: list[RunFolder]) -> None:
    view = compared(*pair)
    view.compare([])
    assert view.comparison is None
    assert figures(view) == []
    assert card(view) == ""


def test_a_click_on_a_mark_of_the_chart_shows_its_picture(pair: list[RunFolder]) -> None:
    view = compared(*pair)
    chart = next(
        pane
        for pane in view.__panel__().select(pn.pane.Plotly)
        if pane.object is not None and pane.object.layout.yaxis.title.text == "PSNR in dB"
    )
    wanted = next(name for name in chart.object.data[0].x if name != view.view)
    chart.click_data = {"points": [{"x": wanted, "y": 20.0}]}
    assert view.view == wanted
    for odd in ({"points": []}, None, {"points": [{"x": "../../secret"}]}):
        chart.click_data = odd
        assert view.view == wanted


def test_what_the_pictures_show_is_chosen_by_buttons(pair: list[RunFolder]) -> None:
    view = compared(*pair)
    assert card(view).count('class="error"') == 2
    modes = next(
        group for group in view.__panel__().select(pn.widgets.RadioButtonGroup) if "error" in group.options.values()
    )
    modes.value = "error"
    assert view.__panel__().select(PictureCard)[0].mode == "error"


def test_points_that_are_missing_are_told_beside_the_paths(pair: list[RunFolder]) -> None:
    view = compared(*pair)
    choice = next(each for each in view.__panel__().select(pn.widgets.Select) if each.label == "Points or mesh")
    choice.value = "gaussians"
    assert "fast: Run " in shown(view)
    assert "has no splat" in shown(view)
    choice.value = ""
    assert "has no splat" not in shown(view)


def test_settings_that_differ_stand_in_groups_with_the_others_marked(
    pair: list[RunFolder], queued: MakeRun
) -> None:
    text = shown(compared(*pair, queued(name="third", loop__rate=0.8, fail_at=3)))
    assert '<tr class="group"><th scope="rowgroup" colspan="4">loop</th></tr>' in text
    assert '<tr class="group"><th scope="rowgroup" colspan="4">general</th></tr>' in text
    row = '<th scope="row">loop.rate</th><td>0.8</td><td class="differs">0.2</td><td>0.8</td>'
    assert row in text


def test_the_mesh_of_a_run_is_drawn_with_the_paths(pair: list[RunFolder]) -> None:
    write_mesh(pair[1].artifacts / "mesh.ply", ball(finer=2))
    view = compared(*pair)
    choice = next(each for each in view.__panel__().select(pn.widgets.Select) if each.label == "Points or mesh")
    choice.value = "mesh"
    traces = [trace for drawn in figures(view) for trace in drawn["data"]]
    assert [trace["name"] for trace in traces if trace["type"] == "mesh3d"] == ["fast: mesh"]
    assert "a mesh of 128 faces, drawn with 128" in shown(view)
    assert "has no mesh" in shown(view)
