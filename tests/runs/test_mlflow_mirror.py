"""What finished runs measured, in a real MLflow store."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import pytest
from fake_recipe import MakeRun

from toolkit.errors import MissingDependencyError, RunError
from toolkit.progress import ProgressEvent


@pytest.fixture
def tracking() -> Any:
    from toolkit.runs import mlflow_mirror  # noqa: F401 - it turns telemetry off before MLflow is loaded

    pytest.importorskip("mlflow", reason="MLflow is not installed: pip install 'sightline-toolkit[mlflow]'")
    pytest.importorskip("sqlalchemy", reason="SQLAlchemy is not installed: pip install 'sightline-toolkit[mlflow]'")
    return pytest.importorskip("mlflow.tracking")


# MLflow sets up its tables in a way that SQLAlchemy is about to drop.
@pytest.mark.filterwarnings("ignore::DeprecationWarning")
def test_finished_runs_are_mirrored_once(
    tracking: Any, queued: MakeRun, finished: MakeRun, runs_dir: Path, tmp_path: Path
) -> None:
    from toolkit.runs.mlflow_mirror import mirror_runs

    first = finished(name="first", seed=3, loop__rate=0.25)
    queued(name="waits")
    (runs_dir / "20200101-000000-fake-0000").mkdir()
    uri = f"sqlite:///{tmp_path / 'store' / 'mlflow.db'}"
    events: list[ProgressEvent] = []
    report = mirror_runs(runs_dir, uri, progress=events.append)
    assert (report.mirrored, report.known, report.unfinished) == (1, 0, 1)
    assert [problem.partition(":")[0] for problem in report.problems] == ["20200101-000000-fake-0000"]
    assert events[-1].done == events[-1].total == 3

    client = tracking.MlflowClient(uri)
    experiment = client.get_experiment_by_name("sightline-toolkit")
    (run,) = client.search_runs([experiment.experiment_id])
    assert run.info.status == "FINISHED"
    assert run.info.run_name == "first"
    assert run.data.params == {
        **{k: str(v) for k, v in first.record().flat_settings.items()},
        "seed": "3",
        "device": "cpu",
    }
    result = first.result()
    wanted = {name: value for name, value in result.metrics.items() if value is not None}
    stored = {name: value for name, value in run.data.metrics.items() if "/" not in name}
    assert stored == pytest.approx({**wanted, "seconds": result.seconds})
    assert run.data.tags["toolkit.run"] == first.id
    assert run.data.tags["toolkit.path.run"] == str(first.path)
    curve = first.curves().find("train", "loss")
    assert curve is not None
    history = sorted(client.get_metric_history(run.info.run_id, "train/loss"), key=lambda metric: metric.step)
    assert [metric.step for metric in history] == curve.steps.tolist()
    assert [metric.value for metric in history] == curve.values.tolist()

    finished(name="second")
    report = mirror_runs(runs_dir, uri)
    assert (report.mirrored, report.known) == (1, 1)
    assert len(client.search_runs([experiment.experiment_id])) == 2


# MLflow sets up its tables in a way that SQLAlchemy is about to drop.
@pytest.mark.filterwarnings("ignore::DeprecationWarning")
def test_a_store_that_refuses_is_told(tracking: Any, finished: MakeRun, runs_dir: Path, tmp_path: Path) -> None:
    from toolkit.runs.mlflow_mirror import mirror_runs

    finished()
    with pytest.raises(RunError, match="The MLflow store nonsense://x refuses; expected one that can be written"):
        mirror_runs(runs_dir, "nonsense://x")
    blocked = tmp_path / "file"
    blocked.write_text("")
    with pytest.raises(RunError, match="Something is in the way while writing"):
        mirror_runs(runs_dir, f"sqlite:///{blocked / 'mlflow.db'}")


def test_without_mlflow_the_cure_is_named(runs_dir: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from toolkit.runs.mlflow_mirror import mirror_runs

    for name in ("mlflow", "mlflow.exceptions"):
        monkeypatch.setitem(sys.modules, name, None)
    with pytest.raises(MissingDependencyError, match=r"Install it: pip install 'sightline-toolkit\[mlflow\]'"):
        mirror_runs(runs_dir, "sqlite:///x.db")
