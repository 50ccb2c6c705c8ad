"""Dockerfile, Binder and JupyterHub: what can be judged of them without building an image."""

from __future__ import annotations

import ast
import os
import re
import shlex
import subprocess
import sys
from pathlib import Path

import pytest

from scripts.workshop.__main__ import ALONE
from scripts.workshop.laptop.kit.installing import PACKAGES
from toolkit.cli import build_parser

ROOT = Path(__file__).parents[2]


def instructions() -> list[tuple[str, str]]:
    """Return the Dockerfile's instructions, lines that go on joined."""
    text = (ROOT / "Dockerfile").read_text(encoding="utf-8")
    lines = [line for line in text.splitlines() if not line.lstrip().startswith("#")]
    joined = "\n".join(lines).replace("\\\n", " ").splitlines()
    return [
        (word, rest.strip()) for line in joined if line.strip() for word, _, rest in [line.strip().partition(" ")]
    ]


def test_what_is_copied_is_there_and_not_ignored() -> None:
    shown = [line[1:] for line in (ROOT / ".dockerignore").read_text().splitlines() if line.startswith("!")]
    copied = [shlex.split(rest) for word, rest in instructions() if word == "COPY"]
    assert copied
    for words in copied:
        if any(word.startswith("--from") for word in words):
            continue
        for source in [word for word in words if not word.startswith("--")][:-1]:
            assert (ROOT / source).exists(), source
            assert any(source.rstrip("/").startswith(name) for name in shown), source


def test_it_does_not_run_as_root_and_says_whether_it_is_well() -> None:
    words = [word for word, _ in instructions()]
    assert [rest for word, rest in instructions() if word == "USER"] == ["jovyan"]
    # Nothing that needs root comes after.
    assert not re.search(
        r"apt-get|pip install", " ".join(rest for _, rest in instructions()[words.index("USER") :])
    )
    (check,) = (rest for word, rest in instructions() if word == "HEALTHCHECK")
    code = ast.literal_eval(check.partition("CMD ")[2])[2]
    compile(code, "healthcheck", "exec")
    assert "/api" in code or "'api'" in code


def test_it_holds_no_secret_and_leaves_the_token_to_jupyter() -> None:
    text = " ".join(f"{word} {rest}" for word, rest in instructions())
    assert not re.search(r"(?i)token=|password|--allow-root|disable_check_xsrf", text)


def test_all_that_pip_installs_is_pinned() -> None:
    settings = " ".join(rest for word, rest in instructions() if word == "ENV")
    assert "PIP_CONSTRAINT=/opt/toolkit/constraints.txt" in settings
    constrained = (ROOT / "constraints.txt").read_text(encoding="utf-8")
    assert re.search(r"^torch==", constrained, re.M)
    # Before anything is installed, the constraints are there.
    words = [f"{word} {rest}" for word, rest in instructions()]
    first = next(i for i, line in enumerate(words) if "pip install" in line)
    assert next(i for i, line in enumerate(words) if line.startswith("COPY constraints.txt")) < first
    post_build = (ROOT / "binder" / "postBuild").read_text(encoding="utf-8")
    assert 'install="python -m pip install --no-cache-dir --constraint constraints.txt"' in post_build
    assert len(re.findall(r"pip install", post_build)) == 1


def test_docker_binder_and_bundle_install_the_same() -> None:
    docker = (ROOT / "Dockerfile").read_text(encoding="utf-8")
    binder = (ROOT / "binder" / "postBuild").read_text(encoding="utf-8")
    for text in (docker, binder):
        assert "'.[ui,geo,video,features]'" in text
        assert f"--no-deps {ALONE['features']}" in text
        assert "jupyter-server-proxy==4.6.0" in text
        assert "--no-deps --index-url https://download.pytorch.org/whl/cpu torch torchvision" in text
    assert ALONE["features"] in (ROOT / "Makefile").read_text(encoding="utf-8")
    assert PACKAGES in docker
    assert (ROOT / "binder" / "apt.txt").read_text(encoding="utf-8").split() == PACKAGES.split()


@pytest.mark.skipif(os.name != "posix", reason="containers run these in a POSIX shell")
def test_a_container_computes_with_as_many_threads_as_it_may_use() -> None:
    command = [
        "sh",
        str(ROOT / "binder" / "start"),
        sys.executable,
        "-c",
        "import os; print(os.environ.get('OMP_NUM_THREADS'))",
    ]
    for limit, threads in (("2.0", "2"), ("0.5", "1"), ("", "None")):
        environment = {"PATH": os.environ["PATH"], "CPU_LIMIT": limit}
        said = subprocess.run(command, env=environment, capture_output=True, text=True, check=True).stdout
        assert said.strip() == threads
    for name in ("start", "postBuild"):
        assert os.access(ROOT / "binder" / name, os.X_OK)
        subprocess.run(["sh", "-n", str(ROOT / "binder" / name)], check=True)


class Config:
    """Takes any setting, as Jupyter's configuration does."""

    def __getattr__(self, name: str) -> Config:
        value = Config()
        setattr(self, name, value)
        return value


def configured(name: str) -> Config:
    config = Config()
    code = (ROOT / "jupyterhub" / name).read_text(encoding="utf-8")
    exec(compile(code, name, "exec"), {"get_config": lambda: config})
    return config


def test_the_proxied_dashboard_is_one_that_the_command_line_knows() -> None:
    (server,) = configured("jupyter_server_config.py").ServerProxy.servers.values()
    python, dash_m, package, *arguments = server["command"]
    assert (python, dash_m, package) == (sys.executable, "-m", "toolkit")
    given = build_parser().parse_args([text.format(port=5006) for text in arguments])
    # Only this machine reaches it but through Jupyter, whose address is not known here.
    assert given.host == "127.0.0.1"
    assert given.origin == ["*"]


def test_the_hub_takes_its_password_from_outside_and_limits_each_participant(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.delenv("WORKSHOP_PASSWORD", raising=False)
    with pytest.raises(KeyError, match="WORKSHOP_PASSWORD"):
        configured("jupyterhub_config.py")
    monkeypatch.setenv("WORKSHOP_PASSWORD", "choose-a-long-one")
    config = configured("jupyterhub_config.py")
    assert config.Spawner.cmd == ["jupyterhub-singleuser"]
    assert config.Spawner.mem_limit == "4G"
    assert config.SharedPasswordAuthenticator.user_password == "choose-a-long-one"
    assert config.DockerSpawner.volumes == {"workshop-{username}": "/home/jovyan/runs"}
