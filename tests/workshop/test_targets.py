"""The kinds of laptops that a bundle is for."""

from __future__ import annotations

import platform
import sys

import pytest
from packaging.markers import Marker, default_environment
from packaging.tags import sys_tags

from scripts.workshop import targets
from scripts.workshop.laptop.kit.here import key_of, this_key
from scripts.workshop.targets import Target, targets_of
from toolkit.errors import SettingsError

WINDOWS, MAC, LINUX = (Target(name, (3, 11)) for name in ("windows", "macos", "linux"))


def test_a_target_is_named_as_its_laptop_names_itself() -> None:
    assert WINDOWS.key == key_of("Windows", "AMD64", (3, 11)) == "windows-x86_64-cp311"
    assert MAC.key == key_of("Darwin", "arm64", (3, 11)) == "macos-arm64-cp311"
    assert LINUX.key == key_of("Linux", "x86_64", (3, 11)) == "linux-x86_64-cp311"
    # What no bundle is made for has a name, too, for the message.
    assert key_of("FreeBSD", "aarch64", (3, 14)) == "freebsd-arm64-cp314"


@pytest.mark.skipif((platform.system(), platform.machine()) != ("Linux", "x86_64"), reason="judged by this machine")
def test_this_machine_is_told_as_python_and_pip_tell_it() -> None:
    (here,) = targets_of(["this"], ["this"])
    assert here.key == this_key()
    judged = default_environment()
    for name in ("os_name", "sys_platform", "platform_system", "platform_machine", "python_version"):
        assert here.markers[name] == judged[name]
    # Those of the newest glibc may be on one side alone.
    assert {tag for tag in sys_tags() if tag.abi in ("abi3", "none")} & set(here.tags)
    assert here.tags[0].abi == f"cp{sys.version_info[0]}{sys.version_info[1]}"


def test_markers_are_judged_as_on_the_target() -> None:
    windows_only = Marker("sys_platform == 'win32' and platform_machine == 'AMD64'")
    assert [windows_only.evaluate(target.markers) for target in (WINDOWS, MAC, LINUX)] == [True, False, False]
    posix = Marker("os_name == 'posix' and python_full_version >= '3.11.5'")
    assert [posix.evaluate(target.markers) for target in (WINDOWS, MAC, LINUX)] == [False, True, True]


def test_pip_is_asked_for_every_platform_whose_wheels_run_there() -> None:
    flags = LINUX.pip_flags
    assert flags[flags.index("--python-version") + 1] == "3.11.9"
    assert "manylinux_2_28_x86_64" in flags
    assert "manylinux2014_x86_64" in flags
    assert "macosx_14_0_arm64" in MAC.pip_flags
    assert "macosx_11_0_universal2" in MAC.pip_flags


def test_every_system_is_taken_with_every_python_once() -> None:
    made = targets_of(["windows", "macos", "windows"], ["3.11", "3.12"])
    assert [target.key for target in made] == [
        "windows-x86_64-cp311",
        "windows-x86_64-cp312",
        "macos-arm64-cp311",
        "macos-arm64-cp312",
    ]


def test_what_no_bundle_can_be_for_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(
        SettingsError, match="Unknown platform 'amiga'; expected one of this, linux, windows, macos"
    ):
        targets_of(["amiga"], ["3.11"])
    with pytest.raises(SettingsError, match="'3.x' is no version of Python; expected as 3.11, or this"):
        targets_of(["linux"], ["3.x"])
    with pytest.raises(SettingsError, match="Python 3.9 is too old for the toolkit; expected 3.11 or newer"):
        targets_of(["linux"], ["3.9"])
    monkeypatch.setattr(targets.platform, "machine", lambda: "riscv64")
    with pytest.raises(SettingsError, match=r"No bundle can be made for this kind of machine; .*found .*riscv64"):
        targets_of(["this"], ["3.11"])
