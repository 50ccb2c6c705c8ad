"""What a recipe is given and what it returns."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

from toolkit.progress import Progress
from toolkit.settings import Settings
from toolkit.workspace import Workspace

if TYPE_CHECKING:  # Reading a result needs neither PyTorch nor pycolmap, which take seconds to import.
    from toolkit.scene import Scene
    from toolkit.splat.gaussians import Gaussians


@dataclass(frozen=True, slots=True)
class RecipeInput:
    """What a method may use, and what it is measured against.

    Attributes
    ----------
    scene:
        Pictures in order, cameras as far as known, sensor priors. No poses, no points.
    reference:
        The same frames with true or surveyed poses where there are any. Only measures may read it.
    fingerprint:
        Hash of the pictures and priors.
    video:
        File of which the pictures are frames, or None. Their times count from its first frame.
    """

    scene: Scene
    reference: Scene | None
    fingerprint: str
    video: Path | None = None


@dataclass(frozen=True, slots=True)
class RecipeContext:
    """Where and how a recipe runs.

    Attributes
    ----------
    workspace:
        Keeps outputs of stages between runs.
    artifacts:
        Folder for what a person looks at: splat, renders, tables.
    checkpoint:
        Folder from which a killed run goes on.
    seed:
        Of every random choice.
    device:
        ``"cpu"`` or ``"cuda"``.
    progress:
        Told of every step; raises to cancel.
    """

    workspace: Workspace
    artifacts: Path
    checkpoint: Path
    seed: int
    device: str
    progress: Progress


@dataclass(frozen=True, slots=True)
class StageTime:
    """Wall time of a stage in seconds; ``reused`` when the output of an earlier run was taken."""

    name: str
    seconds: float
    reused: bool = False


@dataclass(frozen=True, slots=True)
class TestView:
    """One test photo and its render, as paths below the artifacts folder, with its measures."""

    name: str
    photo: str
    render: str
    psnr: float
    ssim: float
    lpips: float | None = None


@dataclass(frozen=True, slots=True)
class RecipeResult:
    """What a recipe made.

    Attributes
    ----------
    scene:
        The frames with the poses that were found.
    gaussians:
        The trained splat, or None for recipes without one.
    times:
        Stages in order.
    metrics:
        Flat table of measures, for example ``{"test.psnr": 24.1}``; None where a measure is not available.
    reports:
        What each stage has to say, by its name.
    test_views:
        Test photos beside their renders.
    """

    scene: Scene
    gaussians: Gaussians | None
    times: tuple[StageTime, ...]
    metrics: dict[str, float | None]
    reports: dict[str, Any] = field(default_factory=dict)
    test_views: tuple[TestView, ...] = ()

    def to_dict(self) -> dict[str, Any]:
        """Return the measures, times and reports, ready for JSON."""
        return {
            "metrics": self.metrics,
            "times": [asdict(time) for time in self.times],
            "reports": self.reports,
            "test_views": [asdict(view) for view in self.test_views],
        }


class RunRecipe(Protocol):
    """The function of a recipe."""

    def __call__(self, data: RecipeInput, settings: Any, context: RecipeContext) -> RecipeResult:
        """Run the method to its end, or raise."""


@dataclass(frozen=True, slots=True)
class Recipe:
    """A method by its name.

    Attributes
    ----------
    name:
        As typed on the command line.
    title:
        A line for a person.
    paper:
        File name of the paper whose table has this row, without ending; empty where there is none.
    description:
        A few sentences: what it does and what it needs.
    settings_type:
        Declares its settings.
    run:
        Does it.
    """

    name: str
    title: str
    paper: str
    description: str
    settings_type: type[Settings]
    run: RunRecipe
