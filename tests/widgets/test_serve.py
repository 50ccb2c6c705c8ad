"""Serving: the page of a visitor, ports, and who gets in."""

from __future__ import annotations

import json
import runpy
import socket
import subprocess
import sys
import urllib.error
import urllib.request
from collections.abc import Sequence
from pathlib import Path

import panel as pn
import pytest
from browsing import dashboard_server, free_port

import toolkit
from toolkit.errors import MissingDependencyError, RunError
from toolkit.runs.folder import RunFolder
from toolkit.widgets.dashboard import dashboard
from toolkit.widgets.page import TITLE
from toolkit.widgets.serve import Opening, serve

pytestmark = pytest.mark.filterwarnings(r"ignore:The inplace keyword in DataFrame\.\w+ is deprecated")


def test_the_page_is_a_template_with_our_title(pair: list[RunFolder], runs_dir: Path) -> None:
    template = dashboard(runs_dir)
    assert isinstance(template, pn.template.FastListTemplate)
    assert template.title == TITLE == "Sightline Toolkit"


def test_panels_own_server_gets_the_folders_from_arguments_and_environment(
    pair: list[RunFolder], runs_dir: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    file = Path(toolkit.__file__).parents[1] / "dashboards" / "app.py"
    asked: list[tuple[Path, Sequence[Path], Sequence[str]]] = []

    def remember(runs: Path, data: Sequence[Path], *, clusters: Sequence[str]) -> pn.template.FastListTemplate:
        asked.append((runs, data, clusters))
        return pn.template.FastListTemplate()

    monkeypatch.setattr("toolkit.widgets.dashboard.dashboard", remember)
    monkeypatch.setattr(sys, "argv", [str(file), "--runs", str(runs_dir), "--data", "a", "b"])
    runpy.run_path(str(file))
    monkeypatch.setattr(sys, "argv", [str(file)])
    monkeypatch.setenv("TOOLKIT_RUNS", "other")
    runpy.run_path(str(file))
    monkeypatch.delenv("TOOLKIT_RUNS")
    runpy.run_path(str(file))
    data = [Path("data")]
    assert asked == [(runs_dir, [Path("a"), Path("b")], []), (Path("other"), data, []), (Path("runs"), data, [])]


def test_a_port_that_is_taken_is_told(runs_dir: Path) -> None:
    with socket.socket() as other:
        other.bind(("127.0.0.1", 0))
        other.listen()
        port = other.getsockname()[1]
        with pytest.raises(RunError, match=rf"Port {port} is taken by another program; expected a free port"):
            serve(runs_dir, opening=Opening(port=port))


def test_a_number_that_is_no_port_is_told(runs_dir: Path) -> None:
    with pytest.raises(RunError, match="70000 is no port; expected a number from 1 to 65535"):
        serve(runs_dir, opening=Opening(port=70000))


def test_a_missing_panel_is_told(runs_dir: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "panel", None)
    with pytest.raises(MissingDependencyError, match=r"sightline-toolkit\[ui\]"):
        serve(runs_dir)


@pytest.mark.parametrize("host", ["0.0.0.0", "192.168.1.5", "example.org"])
def test_a_network_does_not_get_in_without_a_password(runs_dir: Path, host: str) -> None:
    with pytest.raises(RunError, match=rf"open to everyone who reaches {host}.*--passwords"):
        serve(runs_dir, opening=Opening(free_port(), host))


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (None, "There is no file of passwords"),
        ("{", "holds no passwords"),
        ("[]", "holds no passwords.*found list"),
        ("{}", "holds no passwords"),
        ('{"ann": 12345678}', "holds no passwords"),
        ('{"ann": "short"}', "too short.*at least 8 characters.*ann"),
    ],
)
def test_files_that_hold_no_passwords_are_told(
    runs_dir: Path, tmp_path: Path, content: str | None, message: str
) -> None:
    path = tmp_path / "passwords.json"
    if content is not None:
        path.write_text(content)
    with pytest.raises(RunError, match=message):
        serve(runs_dir, opening=Opening(free_port(), "0.0.0.0", path))


def test_who_has_no_password_sees_nothing_but_the_log_in(
    runs_dir: Path, tmp_path: Path, odd_name: str, pair: list[RunFolder]
) -> None:
    passwords = tmp_path / "passwords.json"
    passwords.write_text(json.dumps({"ann": "a long password"}))
    with dashboard_server(runs_dir, [tmp_path], "--passwords", str(passwords)) as address:
        with urllib.request.urlopen(address, timeout=30) as answer:
            assert answer.url.startswith(address + "login")
            page = answer.read().decode()
        assert "password" in page.lower()
        assert pair[0].id not in page
        # The door that sessions go through is closed, too.
        request = urllib.request.Request(address + "ws", headers={"Upgrade": "websocket", "Connection": "Upgrade"})
        with pytest.raises(urllib.error.HTTPError) as refused:
            urllib.request.urlopen(request, timeout=30)
        assert refused.value.code in (400, 401, 403)
        refused.value.close()


def test_the_command_refuses_a_network_without_a_traceback(runs_dir: Path) -> None:
    command = [sys.executable, "-m", "toolkit", "dashboard", "--runs", str(runs_dir), "--host", "0.0.0.0"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=120, check=False)
    assert done.returncode == 2
    assert "error: The dashboard would be open to everyone who reaches 0.0.0.0" in done.stderr
    assert "Traceback" not in done.stderr
