"""The tab of data: only what lies below the data folders is ever shown; what takes time is done in threads."""

from __future__ import annotations

from pathlib import Path

import panel as pn
import pytest
from fake_recipe import write_photos
from page_parts import done, endless, press, said, widget, working

from toolkit.files import write_json
from toolkit.runs.launch import WORKSPACE
from toolkit.scene.dataset import capture_fingerprint, open_capture
from toolkit.scene.folder import write_scene
from toolkit.widgets.data_page import DataPage
from toolkit.workspace import Workspace


@pytest.fixture(autouse=True)
def _no_environment(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("TOOLKIT_DATA", raising=False)
    monkeypatch.delenv("TOOLKIT_CACHE", raising=False)


@pytest.fixture
def data(tmp_path: Path) -> Path:
    write_photos(tmp_path / "data/beach", 6)
    write_photos(tmp_path / "data/nested/deeper/town", 3, seed=1)
    return tmp_path / "data"


@pytest.fixture
def page(runs_dir: Path, data: Path) -> DataPage:
    return DataPage(runs_dir, [data])


def test_captures_are_listed_and_none_is_opened_unasked(page: DataPage, data: Path) -> None:
    choice = widget(page, "Capture")
    assert list(choice.options) == ["– none –", "beach · photos, 6 photos", "nested/deeper/town · photos, 3 photos"]
    assert page.selected == ""
    assert not page.busy
    assert f"2 captures in {data}." in said(page)


def test_a_chosen_capture_is_summed_up_with_thumbnails(page: DataPage, data: Path, runs_dir: Path) -> None:
    widget(page, "Capture").value = str(data / "beach")
    assert page.selected == str(data / "beach")
    assert page.busy
    done(page)
    text = said(page)
    assert "48 × 32 px" in text
    assert "no photo has a GPS position" in text
    assert "Nobody knows where the photos were taken" in text
    assert page.view.grid.content.count("<button") == 6
    assert "photo_3.png" in page.view.grid.content
    assert len(list((runs_dir / ".thumbnails").iterdir())) == 6
    page.view.grid.chosen = 3
    done(page)
    assert "<h3>photo_3.png</h3>" in said(page)
    assert "data:image/jpeg;base64," in said(page)
    page.view.grid.chosen = -1
    assert "<h3>photo_3.png</h3>" not in said(page)


def test_a_number_that_no_photo_has_shows_none(page: DataPage, data: Path) -> None:
    page.selected = str(data / "beach")
    done(page).view.grid.chosen = 99
    assert "<article" not in said(done(page))


def test_another_choice_ends_what_works(page: DataPage, data: Path) -> None:
    page.selected = str(data / "beach")
    page.selected = str(data / "nested/deeper/town")
    done(page)
    assert page.view.opened is not None
    assert page.view.opened.path.name == "town"
    assert page.view.grid.content.count("<button") == 3
    page.selected = ""
    assert page.view.opened is None
    assert page.view.grid.content == ""


@pytest.mark.parametrize(
    ("path", "why"),
    [
        ("/etc", "/etc is not among the data"),
        ("{data}/../secret", "is not among the data"),
        ("{data}/link", "is not among the data"),
        ("../secret", "is not among the data"),
        ("{data}/nested", "is no capture"),
        ("{data}/nowhere", "is no capture"),
        ("{data}/" + "x" * 5000, "This cannot be a folder"),
        ("a\0b", "No folder was named"),
        ("  ", "No folder was named"),
    ],
)
def test_paths_outside_are_refused_with_the_reason(
    page: DataPage, data: Path, tmp_path: Path, path: str, why: str
) -> None:
    write_photos(tmp_path / "secret", 2)
    (data / "link").symlink_to(tmp_path / "secret")
    page.open_path(path.replace("{data}", str(data)))
    assert page.selected == ""
    assert page.view.opened is None
    assert why in said(page)


def test_an_address_that_leads_out_is_refused_too(page: DataPage, tmp_path: Path) -> None:
    secret = write_photos(tmp_path / "secret", 2)
    page.selected = str(secret)
    assert page.selected == ""
    assert not page.busy
    assert "is not among the data" in said(page)
    page.selected = "<img src=x onerror=window.harm=1>"
    assert "<img" not in said(page)
    assert page.selected == ""


def test_a_folder_by_path_may_be_hidden_or_deep(page: DataPage, data: Path) -> None:
    deep = write_photos(data / ".data/a/b/c/d/e/far", 2)
    page.open_path(str(deep))
    assert page.selected == str(deep)
    assert any(".data/a/b/c/d/e/far" in label for label in widget(page, "Capture").options)
    page.look_again()
    assert page.selected == str(deep)


def test_a_scene_that_refers_to_pictures_elsewhere_is_refused(page: DataPage, data: Path, tmp_path: Path) -> None:
    private = write_photos(tmp_path / "private", 2)
    write_scene(open_capture(private).scene, data / "sly")
    page.look_again()
    page.selected = str(data / "sly")
    done(page)
    assert page.view.opened is None
    assert "outside the data folders" in said(page)


def test_a_damaged_capture_is_a_message_and_the_page_goes_on(page: DataPage, data: Path) -> None:
    (data / "bad").mkdir()
    (data / "bad/scene.json").write_text("{")
    page.look_again()
    page.selected = str(data / "bad")
    assert "a JSON file" in said(done(page))
    page.selected = str(data / "beach")
    assert "48 × 32 px" in said(done(page))


def test_names_are_escaped(page: DataPage, data: Path, odd_name: str) -> None:
    harm = odd_name.replace("/", "")
    folder = write_photos(data / harm, 2)
    (folder / "photo_0.png").rename(folder / f"{harm}.png")
    page.look_again()
    page.selected = str(folder)
    done(page)
    for text in (said(page), page.view.grid.content):
        assert "<script>" not in text
        assert "onerror=window.harm=1>" not in text


def test_refresh_finds_what_is_new_and_misses_what_is_gone(page: DataPage, data: Path) -> None:
    page.selected = str(data / "beach")
    done(page)
    write_photos(data / "later", 2)
    page.refresh()
    assert any("later" in label for label in widget(page, "Capture").options)
    assert page.selected == str(data / "beach")
    (data / "beach").rename(data / ".beach")
    page.refresh()
    assert page.selected == ""
    assert "is not there any more" in said(page)


def test_refresh_is_cheap_where_nothing_changed(
    page: DataPage, monkeypatch: pytest.MonkeyPatch, data: Path
) -> None:
    page.selected = str(data / "beach")
    done(page)
    monkeypatch.setattr(DataPage, "look_again", lambda self: pytest.fail("it looked for captures again"))
    monkeypatch.setattr(page.view, "_find_matches", lambda: pytest.fail("it looked for matches again"))
    page.refresh()


def matched(runs_dir: Path, fingerprint: str, pairs: list[list[int]]) -> None:
    workspace = Workspace(runs_dir / WORKSPACE)
    features = workspace.stage("features", inputs={"capture": fingerprint}, settings={}, code="1", build=len_of)

    def build(folder: Path) -> None:
        report = {"pairs_tried": 15, "verified_pairs": pairs, "group_sizes": [3, 2, 1]}
        write_json(folder / "report.json", report)

    inputs = {"features": features.key, "pairs": {"method": "exhaustive"}}
    workspace.stage("matches", inputs=inputs, settings={"pairs": len(pairs)}, code="1", build=build)


def len_of(folder: Path) -> None:
    """Write nothing."""


def test_matches_come_with_the_run_that_finds_them(page: DataPage, data: Path, runs_dir: Path) -> None:
    page.selected = str(data / "beach")
    done(page)
    assert page.view.graphs == ()
    matched(runs_dir, capture_fingerprint(open_capture(data / "beach").scene), [[0, 1, 60, 50], [1, 2, 40, 30]])
    page.refresh()
    done(page)
    (graph,) = page.view.graphs
    assert graph.inliers.tolist() == [50, 30]
    assert "3 groups of 3, 2, 1 photos: no single model holds them all" in said(page)
    shown = [pane.object for pane in page.__panel__().select(pn.pane.Plotly) if pane.visible]
    titles = [figure.layout.title.text for figure in shown]
    assert "2 verified pairs of 6 photos" in titles
    assert "2 of 15 pairs verified" in titles
    page.selected = str(data / "nested/deeper/town")
    done(page)
    assert page.view.graphs == ()
    assert "no single model" not in said(page)


def test_a_method_is_run_on_it_elsewhere(runs_dir: Path, data: Path) -> None:
    asked: list[tuple[str, str]] = []
    page = DataPage(runs_dir, [data], show=lambda tab, capture: asked.append((tab, capture)))
    assert widget(page, "Run a method on it").disabled
    page.selected = str(data / "beach")
    press(page, "Run a method on it")
    assert asked == [("run", str(data / "beach"))]
    done(page)


def test_without_data_folders_it_says_so(runs_dir: Path, tmp_path: Path) -> None:
    page = DataPage(runs_dir, [])
    assert "0 captures in no folder." in said(page)
    page.open_path("/etc")
    assert "there is none" in said(page)
    page.sample.make()
    assert "There is no data folder" in said(page)
    missing = DataPage(runs_dir, [tmp_path / "not yet"])
    missing.refresh()
    assert "0 captures" in said(missing)


def test_a_page_that_is_left_ends_its_looking_and_its_upload(page: DataPage, data: Path) -> None:
    assert page.zip.upload is not None
    page.zip.upload._receiver.hear({"kind": "begin", "upload": 1, "name": "a.zip", "size": 5})
    assert list(data.glob(".upload-*"))
    page.view.opening.begin("Working", endless, lambda made: None)
    page.leave()
    assert not list(data.glob(".upload-*"))
    working(page.view.opening)


def test_many_photos_are_chosen_evenly_and_all_are_measured(runs_dir: Path, tmp_path: Path) -> None:
    write_photos(tmp_path / "many/flight", 70)
    page = DataPage(runs_dir, [tmp_path / "many"])
    page.selected = str(tmp_path / "many/flight")
    done(page)
    assert page.view.grid.content.count("<button") == 60
    assert "60 of 70, evenly chosen." in said(page)
    (bars,) = [pane.object for pane in page.__panel__().select(pn.pane.Plotly) if pane.visible]
    assert sum(len(trace.x) for trace in bars.data) == 70
