"""Where data come from: samples that are made, zips that are sent, and public sets."""

from __future__ import annotations

import io
import zipfile
from pathlib import Path

import panel as pn
import pytest
from fake_recipe import write_photos
from page_parts import done, press, said, widget
from PIL import Image

from toolkit.samples import SampleSettings
from toolkit.samples.data_set import DataFile, DataSet
from toolkit.widgets.data_page import DataPage
from toolkit.widgets.data_sets import DataSets
from toolkit.widgets.sample_form import SampleForm


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


def tiny(form: SampleForm, name: str) -> None:
    form.prepare()
    changes = {"flight.frames": 3, "flight.image_width": 48, "flight.image_height": 36, "town.trees": 0}
    form.form.fill(SampleSettings().replace(changes))
    widget(form, "Name of its folder").value = name


def test_a_sample_is_made_and_shown(page: DataPage, data: Path) -> None:
    tiny(page.sample, "first")
    press(page.sample, "Make it")
    assert page.busy
    done(page)
    assert page.selected == str(data / "first")
    assert "3 of 3 photos (100 %)" in said(page)
    assert page.view.opened is not None
    assert page.view.opened.plane is not None
    tiny(page.sample, "first")
    press(page.sample, "Make it")
    assert "There is a first in" in said(page)
    tiny(page.sample, "../second")
    press(page.sample, "Make it")
    assert "The folder cannot have this name" in said(page)
    assert not (data.parent / "second").exists()


def test_a_zip_is_unpacked_and_shown(page: DataPage, data: Path, tmp_path: Path) -> None:
    def zipped(name: str) -> Path:
        memory = io.BytesIO()
        Image.new("RGB", (20, 10), "red").save(memory, "PNG")
        path = tmp_path / "came.zip"
        with zipfile.ZipFile(path, "w") as archive:
            archive.writestr(name, memory.getvalue())
        return path

    page.zip.unpack("My Fl/ight!.ZIP", zipped("a.png"))
    done(page)
    assert page.selected == str(data / "ight")
    assert not (tmp_path / "came.zip").exists()
    page.zip.unpack("evil.zip", zipped("../a.png"))
    done(page)
    assert "The zip was refused for" in said(page)
    assert not (tmp_path / "came.zip").exists()
    page.zip.unpack("ight.zip", zipped("a.png"))
    assert "There is a ight in" in said(page)
    assert not (tmp_path / "came.zip").exists()
    page.zip.unpack("...zip", zipped("a.png"))
    assert "The folder cannot have this name" in said(page)


def entry(name: str, **more: object) -> DataSet:
    files = {
        "a.jpg": DataFile("https://example.org/a.jpg", None if more.pop("unknown", False) else "0" * 64, 2_000_000)
    }
    texts = {
        "title": f"<b>{name}",
        "source": "here",
        "commit": None,
        "licence": "CC0",
        "citation": "them",
        "files": files,
    }
    return DataSet(name=name, local=name, **{**texts, **more})


def test_sets_say_what_can_be_done_with_them(data: Path) -> None:
    taken: list[Path] = []
    sets = {
        each.name: each
        for each in (
            entry("far"),
            entry("asked", files={}, how_to_get="Ask the authors <now>"),
            entry("doubtful", unknown=True),
        )
    }
    form = DataSets([data], taken.append, sets=sets)
    choice, fetch, show = widget(form, "Data set"), widget(form, "Fetch"), widget(form, "Show it")
    assert list(choice.options) == ["far · 2.0 MB to fetch", "asked · by hand", "doubtful · 2.0 MB to fetch"]
    assert "&lt;b&gt;far" in said(form)
    assert (fetch.disabled, show.disabled) == (False, True)
    choice.value = "asked"
    assert "Ask the authors &lt;now&gt;" in said(form)
    assert (fetch.disabled, show.disabled) == (True, True)
    choice.value = "doubtful"
    assert fetch.disabled
    (consent,) = form.__panel__().select(pn.widgets.Checkbox)
    assert consent.visible
    consent.value = True
    assert not fetch.disabled


def test_a_set_that_is_here_is_shown(data: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    taken: list[Path] = []
    monkeypatch.setenv("TOOLKIT_DATA", str(data))
    form = DataSets([data], taken.append, sets={"beach": entry("beach")})
    assert list(widget(form, "Data set").options) == ["beach · here"]
    press(form, "Show it")
    assert taken == [data / "beach"]
    monkeypatch.setenv("TOOLKIT_DATA", str(data / "nowhere"))
    form.refresh()
    assert list(widget(form, "Data set").options) == ["beach · 2.0 MB to fetch"]


def test_a_set_outside_the_data_folders_is_not_shown(page: DataPage, tmp_path: Path) -> None:
    page._take_new(write_photos(tmp_path / "elsewhere", 2))
    assert page.selected == ""
    assert "is not among the data folders of this page" in said(page)
