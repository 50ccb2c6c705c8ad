"""What a run leaves behind in ``artifacts``: measures, scene, splat and trajectory, written and read back."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path, PurePath
from typing import TYPE_CHECKING, Any

import numpy as np

from toolkit.errors import DataError
from toolkit.files import read_json, write_json
from toolkit.recipes.base import RecipeResult, StageTime, TestView
from toolkit.runs.trajectories import trajectory_table

if TYPE_CHECKING:
    from toolkit.scene import Scene

RESULT, SCENE, SPLAT, TRAJECTORY = "result.json", "scene", "splat.ply", "trajectory.json"


@dataclass(frozen=True, slots=True)
class StoredResult:
    """result.json read back: what :meth:`RecipeResult.to_dict` wrote, without scene and splat."""

    metrics: dict[str, float | None]
    times: tuple[StageTime, ...]
    reports: dict[str, Any] = field(default_factory=dict)
    test_views: tuple[TestView, ...] = ()

    @property
    def seconds(self) -> float:
        """Wall time of all stages, reused ones with the time that they once took."""
        return sum(time.seconds for time in self.times)


def write_result(result: RecipeResult, reference: Scene | None, artifacts: Path) -> list[str]:
    """Write scene, splat, trajectory and, last, result.json; return the names of values that were not finite.

    JSON has no NaN and no infinity: such values are stored as null.

    Raises
    ------
    RunError
        When the disk is full or may not be written.
    ToolkitError
        Where scene, splat or a report holds something that cannot be stored.
    """
    from toolkit.scene.folder import write_scene

    write_scene(result.scene, artifacts / SCENE)
    write_json(artifacts / TRAJECTORY, trajectory_table(result.scene, reference))
    if result.gaussians is not None:
        from toolkit.splat.ply import write_splats

        write_splats(result.gaussians, artifacts / SPLAT)
    not_finite: list[str] = []
    write_json(artifacts / RESULT, plain(result.to_dict(), not_finite))
    return not_finite


def plain(value: Any, not_finite: list[str], where: str = "result") -> Any:
    """Return ``value`` as JSON knows it, adding the places of NaN and infinities to ``not_finite``.

    Raises
    ------
    DataError
        For a value that is neither number, text, list, table, path nor dataclass.
    """
    if value is None or isinstance(value, str | bool | int):
        return value
    if isinstance(value, float | np.floating):
        if math.isfinite(value):
            return float(value)
        not_finite.append(where)
        return None
    if isinstance(value, np.integer | np.bool_):
        return value.item()
    if isinstance(value, PurePath):
        return value.as_posix()
    if isinstance(value, np.ndarray):
        return plain(value.tolist(), not_finite, where)
    if isinstance(value, Mapping):
        return {str(key): plain(item, not_finite, f"{where}.{key}") for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [plain(item, not_finite, f"{where}[{i}]") for i, item in enumerate(value)]
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return plain(dataclasses.asdict(value), not_finite, where)
    raise DataError(
        f"{where} cannot be stored", expected="numbers, texts, lists and tables", found=type(value).__name__
    )


def read_result(artifacts: Path) -> StoredResult:
    """Return what result.json says.

    Raises
    ------
    DataError
        Where it is missing or damaged, or names pictures outside the run.
    """
    path = artifacts / RESULT
    content = read_json(path)
    try:
        result = StoredResult(
            metrics={str(name): None if v is None else float(v) for name, v in content["metrics"].items()},
            times=tuple(
                StageTime(str(t["name"]), float(t["seconds"]), bool(t["reused"])) for t in content["times"]
            ),
            reports=dict(content["reports"]),
            test_views=tuple(_view(view) for view in content["test_views"]),
        )
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise DataError(
            f"{path} is damaged", expected="metrics, times, reports and test_views", found=repr(error)
        ) from error
    root = artifacts.resolve()
    for view in result.test_views:
        for picture in (view.photo, view.render):
            if not (root / picture).resolve().is_relative_to(root):
                raise DataError(
                    f"{path} names a picture outside the run",
                    expected="paths below artifacts",
                    found=repr(picture),
                )
    return result


def _view(content: Mapping[str, Any]) -> TestView:
    """Return a test view; measures that were not finite come back as NaN."""

    def number(value: Any) -> float:
        return math.nan if value is None else float(value)

    return TestView(
        name=str(content["name"]),
        photo=str(content["photo"]),
        render=str(content["render"]),
        psnr=number(content["psnr"]),
        ssim=number(content["ssim"]),
        lpips=None if content["lpips"] is None else number(content["lpips"]),
    )
