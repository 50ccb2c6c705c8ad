"""A stage with its report, kept in the workspace, timed whether it is built now or found."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType
from typing import Any

from toolkit.files import read_json, write_json
from toolkit.progress import ProgressEvent
from toolkit.recipes.base import RecipeContext, StageTime
from toolkit.settings import Settings
from toolkit.workspace import StageOutput, code_version

_REPORT = "report.json"


@dataclass(frozen=True, slots=True)
class CachedStage:
    """The output of a stage with what it reported."""

    output: StageOutput
    report: dict[str, Any]
    time: StageTime

    @property
    def folder(self) -> Path:
        """Where the stage's files are."""
        return self.output.folder


def cached_stage(
    context: RecipeContext,
    name: str,
    *,
    inputs: Mapping[str, Any],
    settings: Settings | None,
    code: tuple[ModuleType, ...],
    build: Callable[[Path], Mapping[str, Any]],
) -> CachedStage:
    """Return the output of stage ``name``, building it where the workspace does not have it.

    ``build(folder)`` writes the stage's files and returns its report. The seed belongs to the inputs.
    """

    def build_with_report(folder: Path) -> None:
        write_json(folder / _REPORT, dict(build(folder)))

    output = context.workspace.stage(
        name,
        inputs={**inputs, "seed": context.seed},
        settings=settings.to_dict() if settings is not None else None,
        code=code_version(*code),
        build=build_with_report,
    )
    if output.reused:
        context.progress(ProgressEvent(name, 1, 1, "reused from an earlier run"))
    return CachedStage(output, read_json(output.folder / _REPORT), StageTime(name, output.seconds, output.reused))
