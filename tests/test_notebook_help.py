"""What notebooks lean on: work folders, bars that end, samples made once, tables and paths in one frame."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from toolkit.errors import DataError, RunError
from toolkit.files import write_json
from toolkit.geometry.cameras import ColmapCamera
from toolkit.geometry.rigid import RigidTransform
from toolkit.notebook import (
    CellProgress,
    best_text,
    measures_text,
    nearby_frames,
    poses_figure,
    sample_folder,
    seconds_figure,
    surface_measures,
    work_folder,
)
from toolkit.progress import ProgressEvent
from toolkit.runs.folder import RunFolder
from toolkit.samples.make import SampleSettings
from toolkit.scene import Frame, Points, Scene
from toolkit.scene.scene import Tracks


def test_work_lies_below_runs_and_beside_the_notebooks(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    assert work_folder("tour") == tmp_path / "runs" / "tour"
    assert (tmp_path / "runs" / "tour").is_dir()
    (tmp_path / "notebooks").mkdir()
    monkeypatch.chdir(tmp_path / "notebooks")
    assert work_folder("tour") == tmp_path / "runs" / "tour"


def test_a_file_in_the_way_of_the_work_folder_is_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "runs").write_text("")
    with pytest.raises(RunError, match="Something is in the way while making"):
        work_folder("tour")


def test_a_bar_ends_with_its_stage_and_once(capsys: pytest.CaptureFixture[str]) -> None:
    bar = CellProgress()
    for done in (0, 1, 2, 2, 2):
        bar(ProgressEvent("match", done, 2))
    bar(ProgressEvent("sfm", 0, 1))
    bar(ProgressEvent("sfm", 1, 1))
    captured = capsys.readouterr()
    assert captured.err == ""  # which notebooks show as if something were wrong
    assert captured.out.count("\n") == 2
    assert "match: 100%" in captured.out
    assert "sfm: 100%" in captured.out


def test_the_same_stage_may_begin_again(capsys: pytest.CaptureFixture[str]) -> None:
    bar = CellProgress()
    for done in (0, 1, 0, 1):
        bar(ProgressEvent("match", done, 1))
    assert capsys.readouterr().out.count("\n") == 2


def test_a_sample_is_made_once_for_the_same_settings(tmp_path: Path) -> None:
    tiny = SampleSettings().replace({"flight.frames": 2, "flight.image_width": 32, "flight.image_height": 24})
    folder = sample_folder(tmp_path, tiny)
    made = (folder / "sample.json").stat().st_mtime_ns
    assert sample_folder(tmp_path, tiny) == folder
    assert (folder / "sample.json").stat().st_mtime_ns == made
    assert sample_folder(tmp_path, tiny, seed=1) != folder


def test_measures_are_columns_with_gaps() -> None:
    lines = measures_text({"a": {"pos": 0.5, "ate": None}, "b": {"pos": 2.0}}).splitlines()
    assert [line.split() for line in lines] == [["a", "b"], ["pos", "0.5000", "2"], ["ate", "–", "–"]]
    assert measures_text({"a": {}}) == "Nothing was measured: the data have no reference."


def scene(scale: float, count: int = 6) -> Scene:
    places = [(scale * np.cos(i), scale * np.sin(i), scale) for i in range(count)]
    frames = tuple(Frame(f"{i}.jpg", 1, RigidTransform.look_at(place, (0, 0, 0))) for i, place in enumerate(places))
    return Scene(Path("images"), {1: ColmapCamera.pinhole(64, 48, 60.0)}, frames)


def test_paths_are_laid_onto_the_reference() -> None:
    figure = poses_figure({"half": scene(0.5), "<none>": scene(1.0).without_poses()}, scene(1.0))
    half, truth = (next(item for item in figure.data if item.name == name) for name in ("half", "reference"))
    np.testing.assert_allclose(np.asarray(half.x, float), np.asarray(truth.x, float), atol=1e-9)
    assert "Sim(3)" in figure.layout.title.text
    assert "<none>" not in figure.layout.title.text  # shown, not obeyed
    assert "&lt;none&gt;" in figure.layout.title.text


def test_without_a_reference_the_first_path_stands_still() -> None:
    figure = poses_figure({"first": scene(2.0), "second": scene(5.0)}, None)
    first, second = (next(item for item in figure.data if item.name == name) for name in ("first", "second"))
    np.testing.assert_allclose(np.asarray(first.z, float), 2.0)
    np.testing.assert_allclose(np.asarray(second.z, float), 2.0)


def test_seconds_are_bars_built_of_steps() -> None:
    figure = seconds_figure({"short": {"match": 1.0}, "long": {"match": 2.0, "solve": 5.0}})
    bars = {bar.name: list(bar.x) for bar in figure.data}
    assert bars == {"match": [1.0, 2.0], "solve": [None, 5.0]}


def test_what_runs_with_surfaces_measured_is_in_millimetres(tmp_path: Path) -> None:
    run = RunFolder(tmp_path / "run")
    times = [{"name": n, "seconds": s, "reused": False} for n, s in (("stereo", 3.6), ("measure mesh", 9.0))]
    metrics = {"mesh.accuracy": 0.0021, "mesh.f_score": 0.5, "mesh.faces": None}
    write_json(run.result_file, {"metrics": metrics, "times": times, "reports": {}, "test_views": []})
    measures = surface_measures(run)
    assert measures["accuracy [mm]"] == pytest.approx(2.1)
    assert measures["F-score [%]"] == 50
    assert measures["faces"] is None
    assert measures["PSNR [dB]"] is None
    assert measures["time [s]"] == 4


def test_the_best_of_each_measure_is_told_with_the_next() -> None:
    columns = {"a": {"x": 3.0, "y": 1.0}, "b": {"x": 2.0, "y": None}, "c": {"x": 1.5}}
    told = best_text(columns, {"x": "lower", "y": "higher", "z": "lower"})
    assert told.splitlines() == ["x: c (1.500), then b (2)", "y: a (1)", "z: not measured"]
    assert best_text(columns, {"x": "higher"}) == "x: a (3), then b (2)"


def test_frames_near_one_are_kept_and_points_lose_their_tracks() -> None:
    seen = Tracks(np.array([0, 1]), np.array([0, 7]), np.zeros((2, 2)))
    whole = scene(1.0, 8).replace(points=Points(np.zeros((2, 3)), np.zeros((2, 3), np.uint8), tracks=seen))
    few = nearby_frames(whole, "6.jpg", reach=2)
    assert [frame.name for frame in few.frames] == ["4.jpg", "5.jpg", "6.jpg", "7.jpg"]
    assert few.points is not None
    assert few.points.tracks is None
    assert nearby_frames(whole.replace(points=None), "0.jpg").points is None
    with pytest.raises(DataError, match="nowhere.jpg"):
        nearby_frames(whole, "nowhere.jpg")
