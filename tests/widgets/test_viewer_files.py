"""The viewers' JavaScript is one module without a bundler, and what is not built says so."""

from __future__ import annotations

import json
import re
import shutil
import subprocess
from pathlib import Path

import pytest

from toolkit.widgets import viewer_files
from toolkit.widgets.viewer_files import FOLDER, NOT_BUILT, is_built, plain_module


def test_the_streamed_viewer_is_one_module_without_imports() -> None:
    text = plain_module("stream.js")
    assert not re.search(r"^\s*import\b", text, re.MULTILINE)
    assert "http" not in text
    # A name that two modules define would be an error in the browser.
    names = re.findall(r"^(?:export )?(?:const|function|class|async function) (\w+)", text, re.MULTILINE)
    assert sorted(set(names)) == sorted(names)
    assert {"Navigation", "Stage", "render", "cameraAt"} <= set(names)


def test_the_streamed_viewer_is_sound_javascript(tmp_path: Path) -> None:
    node = shutil.which("node")
    if node is None:
        pytest.skip("node is not installed: apt-get install nodejs")
    (tmp_path / "stream.mjs").write_text(plain_module("stream.js"), encoding="utf-8")
    checked = subprocess.run([node, "--check", str(tmp_path / "stream.mjs")], capture_output=True, text=True)
    assert checked.returncode == 0, checked.stderr


def test_what_is_not_built_is_told_with_the_command(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(viewer_files, "BUNDLE", "viewer/dist/nothing.js")
    assert not is_built()
    assert "sh scripts/build_viewer.sh" in NOT_BUILT
    assert (Path(__file__).parents[2] / "scripts" / "build_viewer.sh").is_file()


def test_packages_are_pinned_to_one_version_with_a_lock() -> None:
    package = json.loads((FOLDER / "package.json").read_text(encoding="utf-8"))
    lock = json.loads((FOLDER / "package-lock.json").read_text(encoding="utf-8"))
    for name, version in (package["dependencies"] | package["devDependencies"]).items():
        assert re.fullmatch(r"\d+\.\d+\.\d+", version)
        assert lock["packages"][f"node_modules/{name}"]["version"] == version
    for name, entry in lock["packages"].items():
        assert not name or entry["integrity"].startswith("sha512-")


def test_the_bundle_comes_with_the_licences_of_what_is_in_it() -> None:
    if not is_built():
        pytest.skip("the WebGL viewer is not built: make viewer")
    text = (FOLDER / "dist" / "LICENSES.txt").read_text(encoding="utf-8")
    for name in ("three ", "@sparkjsdev/spark "):
        assert re.search(rf"^{name}[\d.]+ \(MIT\)$", text, re.MULTILINE)
    assert "Permission is hereby granted, free of charge" in text
