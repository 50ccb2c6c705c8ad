"""The wheels of a target: all that it needs and nothing else, whatever machine asks for them."""

from __future__ import annotations

import subprocess
from collections.abc import Sequence
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from packaging.specifiers import SpecifierSet
from tiny_wheels import write_wheel

from scripts.workshop import wheels
from scripts.workshop.targets import Target
from scripts.workshop.wheels import Wanted, collect, fitting, pip_fetch, read_pins, requires, with_cpu_torch
from toolkit.errors import DataError, StageError

WINDOWS, LINUX = Target("windows", (3, 11)), Target("linux", (3, 11))
WINDOWS_TAG, LINUX_TAG = "cp311-cp311-win_amd64", "cp311-cp311-manylinux_2_28_x86_64"


class Index:
    """An index of wheels, made when they are asked for; notes what it was asked."""

    def __init__(
        self, folder: Path, known: dict[str, tuple[str, ...]], versions: dict[str, str] | None = None
    ) -> None:
        self.folder, self.known, self.versions = folder, known, versions or {}
        self.asked: list[list[str]] = []

    def __call__(self, requirements: Sequence[str], target: Target) -> None:
        self.asked.append([Requirement(text).name for text in requirements])
        for text in requirements:
            name = Requirement(text).name
            tag = (WINDOWS_TAG if target is WINDOWS else LINUX_TAG) if name.startswith("built") else "py3-none-any"
            write_wheel(self.folder, name, self.versions.get(name, "1.0"), tag=tag, requires=self.known[name])


APP = {
    "app": (
        "built-core>=1",
        "colour; sys_platform == 'win32'",
        "glibc-thing; platform_system == 'Linux'",
        "page[fancy]; extra == 'ui'",
        "never; extra == 'slam'",
    ),
    "built-core": (),
    "colour": (),
    "glibc-thing": (),
    "page": ("base", "glitter; extra == 'fancy'", "dull; extra == 'plain'"),
    "base": (),
    "glitter": ("base>=1.0",),
}


def test_markers_and_extras_are_followed_as_on_the_target(tmp_path: Path) -> None:
    index = Index(tmp_path, APP)
    there = collect(tmp_path, WINDOWS, Wanted(("app[ui]",)), index)
    assert sorted(there) == ["app", "base", "built-core", "colour", "glitter", "page"]
    assert there["built-core"].name == f"built_core-1.0-{WINDOWS_TAG}.whl"
    # The second target has most of it already, and needs a wheel of its own where there is compiled code.
    index.asked.clear()
    there = collect(tmp_path, LINUX, Wanted(("app[ui]",)), index)
    assert sorted(there) == ["app", "base", "built-core", "glibc-thing", "glitter", "page"]
    assert index.asked == [["built-core", "glibc-thing"]]
    # And the next call asks for nothing.
    assert collect(tmp_path, LINUX, Wanted(("app[ui]",)), Index(tmp_path, {})) == there


def test_what_stands_alone_brings_nothing_with_it(tmp_path: Path) -> None:
    index = Index(tmp_path, {"app": (), "lone": ("opencv-python",)})
    there = collect(tmp_path, LINUX, Wanted(("app",), ("lone==1.0",)), index)
    assert sorted(there) == ["app", "lone"]


def test_pinned_versions_are_asked_for_and_others_passed_over(tmp_path: Path) -> None:
    write_wheel(tmp_path, "base", "2.0")
    index = Index(tmp_path, {"app": ("base>=1.0",), "base": ()}, {"base": "1.5"})
    there = collect(tmp_path, LINUX, Wanted(("app",), pins={"base": "1.5"}), index)
    assert there["base"].name == "base-1.5-py3-none-any.whl"
    assert fitting(tmp_path, "base", SpecifierSet(), LINUX) == tmp_path / "base-2.0-py3-none-any.whl"


def test_an_extra_that_is_asked_for_later_is_followed_too(tmp_path: Path) -> None:
    known = {
        "app": ("page", "more"),
        "more": ("page[fancy]",),
        **{name: APP[name] for name in ("page", "base", "glitter")},
    }
    assert "glitter" in collect(tmp_path, LINUX, Wanted(("app",)), Index(tmp_path, known))


def test_a_wheel_that_nobody_has_is_told_with_who_needs_it(tmp_path: Path) -> None:
    index = Index(tmp_path, {"app": ("base>=2",), "base": ()})
    expected = (
        r"There is no wheel of base for linux-x86_64-cp311; expected base>=2, which app needs; "
        r"found base-1.0-py3-none-any.whl"
    )
    with pytest.raises(StageError, match=expected):
        collect(tmp_path, LINUX, Wanted(("app",)), index)


def test_damaged_wheels_are_told(tmp_path: Path) -> None:
    broken = tmp_path / "app-1.0-py3-none-any.whl"
    broken.write_bytes(b"half of it")
    with pytest.raises(DataError, match="cannot be read; expected a wheel with its METADATA"):
        collect(tmp_path, LINUX, Wanted(("app",)), Index(tmp_path, {}))
    other = write_wheel(tmp_path / "other", "app", requires=["not a requirement at all"])
    assert requires(other) == ("not a requirement at all",)
    with pytest.raises(DataError, match="asks for what cannot be read; found not a requirement at all"):
        collect(tmp_path / "other", LINUX, Wanted(("app",)), Index(tmp_path, {}))
    (tmp_path / "strange.whl").write_bytes(b"")
    with pytest.raises(DataError, match=r"strange.whl is no wheel; .*Remove it"):
        fitting(tmp_path, "app", SpecifierSet(), LINUX)


def test_constraints_are_read_line_by_line(tmp_path: Path) -> None:
    path = tmp_path / "constraints.txt"
    path.write_text("# as tested\nTorch==2.14.1\nsome_thing==1.0  # why\n", encoding="utf-8")
    assert read_pins(path) == {"torch": "2.14.1", "some-thing": "1.0"}
    path.write_text("torch>=2\n", encoding="utf-8")
    with pytest.raises(DataError, match="has a line that pins nothing; expected name==version; found torch>=2"):
        read_pins(path)


def test_on_linux_pytorch_is_the_one_for_the_cpu(tmp_path: Path) -> None:
    pins = with_cpu_torch({"torch": "2.14.1", "torchvision": "0.29.1", "numpy": "2.4.6"})
    assert pins == {"torch": "2.14.1+cpu", "torchvision": "0.29.1+cpu", "numpy": "2.4.6"}
    # What PyPI has in the same version does not pass for it.
    write_wheel(tmp_path, "torch", "2.14.1")
    asked = SpecifierSet(f"=={pins['torch']}")
    assert fitting(tmp_path, "torch", asked, LINUX) is None
    write_wheel(tmp_path, "torch", "2.14.1+cpu")
    assert fitting(tmp_path, "torch", asked, LINUX) == tmp_path / "torch-2.14.1+cpu-py3-none-any.whl"
    with pytest.raises(DataError, match="The constraints pin no version of torchvision"):
        with_cpu_torch({"torch": "2.14.1"})


def test_pip_is_sent_to_the_index_for_the_cpu_only_for_pytorch_on_linux(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    commands: list[list[str]] = []

    def run(command: list[str], **_: object) -> subprocess.CompletedProcess[str]:
        commands.append(command)
        return subprocess.CompletedProcess(command, 0, "", "")

    monkeypatch.setattr(wheels.subprocess, "run", run)
    fetch = pip_fetch(tmp_path, torch_index="https://example.org/cpu")
    fetch(["numpy==2", "torch==2.14.1+cpu"], LINUX)
    assert [("https://example.org/cpu" in command, command[-1]) for command in commands] == [
        (True, "torch==2.14.1+cpu"),
        (False, "numpy==2"),
    ]
    commands.clear()
    fetch(["numpy==2", "torch==2.14.1"], WINDOWS)
    assert [command[-2:] for command in commands] == [["numpy==2", "torch==2.14.1"]]
    assert "--index-url" not in commands[0]
    assert "--no-deps" in commands[0]


def test_what_pip_cannot_find_is_told_by_its_own_words(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    # No index at all: as without a network, but at once.
    monkeypatch.setenv("PIP_NO_INDEX", "1")
    monkeypatch.setenv("PIP_CONFIG_FILE", str(tmp_path / "none"))
    monkeypatch.delenv("PIP_FIND_LINKS", raising=False)
    with pytest.raises(
        StageError, match=r"pip did not bring the wheels for windows-x86_64-cp311; expected nowhere==1"
    ):
        pip_fetch(tmp_path, torch_index=None)(["nowhere==1"], WINDOWS)
