"""Settings, runs and comparisons as widgets of a notebook: the same declarations, the same folders."""

from __future__ import annotations

import io
import threading
from pathlib import Path

import numpy as np
import pytest
from fake_recipe import RECIPE, FakeSettings, MakeRun, write_photos
from PIL import Image
from shapes import ball

from toolkit.errors import SettingsError
from toolkit.recipes.colmap_3dgs import RECIPE as COLMAP_3DGS
from toolkit.runs.cancel import CancelRequests
from toolkit.runs.folder import RunFolder
from toolkit.runs.launch import execute
from toolkit.scene.mesh_files import write_mesh
from toolkit.widgets.notebook_compare import CompareBox
from toolkit.widgets.notebook_run import RunBox
from toolkit.widgets.notebook_settings import SettingsBox

pytest.importorskip("ipywidgets", reason="ipywidgets is not installed: pip install 'sightline-toolkit[ui]'")


def test_every_setting_of_a_method_has_a_widget_with_its_help_and_default() -> None:
    box = SettingsBox(COLMAP_3DGS.settings_type)
    rows = COLMAP_3DGS.settings_type.table()
    assert list(box.widgets) == [row.name for row in rows]
    for row in rows:
        assert box.widgets[row.name].value == row.default
        assert row.doc in box.widgets[row.name].tooltip
    assert box.settings().to_dict() == COLMAP_3DGS.settings_type().to_dict()
    assert box.changed == []


def test_what_differs_is_marked() -> None:
    box = SettingsBox(FakeSettings)
    box.widgets["loop.steps"].value = 7
    assert box.changed == ["loop.steps"]
    assert box.widgets["loop.steps"].description.startswith("● ")
    assert dict(box.settings().items())["loop.steps"] == 7
    box.fill(FakeSettings())
    assert box.changed == []
    assert not box.widgets["loop.steps"].description.startswith("● ")


def test_a_value_out_of_range_is_told_and_not_changed_silently() -> None:
    box = SettingsBox(FakeSettings)
    box.widgets["loop.steps"].value = -3
    assert "steps" in box._message.value
    with pytest.raises(SettingsError, match=r"In 'loop': Setting 'steps' is out of range"):
        box.settings()


@pytest.fixture
def in_thread() -> object:
    """Return a starter that works on a run of the fake recipe in a thread, as another process would."""

    def start(run: RunFolder) -> None:
        threading.Thread(target=execute, args=(run, CancelRequests(run)), kwargs={"recipe": RECIPE}).start()

    return start


def run_box(tmp_path: Path, runs_dir: Path, start: object, monkeypatch: pytest.MonkeyPatch) -> RunBox:
    monkeypatch.setattr("toolkit.widgets.notebook_run.find_recipe", lambda name: RECIPE)
    monkeypatch.setattr("toolkit.widgets.notebook_run.EVERY", 0.05)
    return RunBox("fake", write_photos(tmp_path / "photos"), runs_dir, start=start)


def test_a_run_is_started_followed_and_ends_with_its_measures(
    tmp_path: Path, runs_dir: Path, in_thread: object, monkeypatch: pytest.MonkeyPatch
) -> None:
    box = run_box(tmp_path, runs_dir, in_thread, monkeypatch)
    box.settings.widgets["loop.steps"].value = 30
    box.start()
    assert box._start.disabled
    assert box.wait(20)
    assert box.run is not None
    assert box.run.status().state == "finished"
    assert box.run.record().flat_settings["loop.steps"] == 30
    assert len(box._curve.data[0].x) == 30
    assert "test.psnr" in box._result.value
    assert not box._start.disabled
    assert box._cancel.disabled


def test_settings_that_cannot_be_start_nothing(
    tmp_path: Path, runs_dir: Path, in_thread: object, monkeypatch: pytest.MonkeyPatch
) -> None:
    box = run_box(tmp_path, runs_dir, in_thread, monkeypatch)
    box.settings.widgets["loop.steps"].value = -1
    box.start()
    assert box.run is None
    assert "steps" in box._result.value
    assert not runs_dir.exists()


def test_two_finished_runs_are_side_by_side_and_the_slider_moves(pair: list[RunFolder], runs_dir: Path) -> None:
    box = CompareBox(runs_dir)
    assert list(box.pick.value) == [run.id for run in pair]
    assert "<script>window.harm" not in box._tables.value
    assert "loop.rate" in box._tables.value
    assert len(box.pictures.children) == 2
    before = box.pictures.children[0].children[1].value
    box.split.value = 100
    photo = np.array(Image.open(io.BytesIO(box.pictures.children[0].children[1].value)))
    box.split.value = 0
    render = np.array(Image.open(io.BytesIO(box.pictures.children[0].children[1].value)))
    assert before != box.pictures.children[0].children[1].value
    assert photo.shape == render.shape
    assert (photo != render).any()


def test_meshes_are_drawn_with_the_paths_where_they_are_chosen(pair: list[RunFolder], runs_dir: Path) -> None:
    write_mesh(pair[1].artifacts / "mesh.ply", ball(finer=2))
    box = CompareBox(runs_dir)
    (plain,) = box._paths.children
    assert not [trace for trace in plain.data if trace.type == "mesh3d"]
    assert box._path_remarks.value == ""
    box.shape.value = "mesh"
    (drawn,) = box._paths.children
    assert [trace.name for trace in drawn.data if trace.type == "mesh3d"] == ["fast: mesh"]
    assert "has no mesh" in box._path_remarks.value


def test_nothing_chosen_is_told(finished: MakeRun, runs_dir: Path) -> None:
    finished()
    box = CompareBox(runs_dir)
    box.pick.value = ()
    assert "Choose runs" in box._tables.value
    assert box.comparison is None
    assert box.pictures.children == ()
