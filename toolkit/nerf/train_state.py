"""All that changes while a field is trained, and its way into a checkpoint and back."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from toolkit.checkpoint import Checkpoint
from toolkit.errors import NumericalError
from toolkit.nerf.field import RadianceField
from toolkit.nerf.settings import NerfSettings
from toolkit.nerf.space import Space
from toolkit.nerf.weights_file import set_tensors, warm_start


@dataclass(frozen=True, slots=True)
class NerfRow:
    """A step that was measured: the mean loss since the last one, that of depth or None, PSNR in dB or None."""

    step: int
    loss: float
    depth_loss: float | None = None
    psnr_test: float | None = None


@dataclass
class NerfState:
    """A training between two steps.

    Attributes
    ----------
    field, optimiser:
        What is learned, and Adam with its moments.
    generator:
        The only source of randomness, on the CPU.
    step:
        Steps that are done.
    history:
        A row every measured step.
    seconds:
        Wall time in all sessions, by what it was spent on.
    per_ray:
        Samples of a ray in the last step, 0 before the first.
    """

    field: RadianceField
    optimiser: torch.optim.Adam
    generator: torch.Generator
    step: int = 0
    history: list[NerfRow] = dataclasses.field(default_factory=list)
    seconds: dict[str, float] = dataclasses.field(default_factory=dict)
    per_ray: float = 0.0

    @classmethod
    def start(cls, settings: NerfSettings, space: Space, kept: Tensor | None, seed: int, device: str) -> NerfState:
        """Return the state before the first step; with ``warm_start`` the weights and the space of another run.

        ``kept`` are world points (n, 3) whose surroundings are never taken for empty, or None.
        """
        generator = torch.Generator().manual_seed(seed)
        made = RadianceField(settings, space, generator)
        if settings.warm_start:
            warm_start(made, Path(settings.warm_start))
        if made.occupancy is not None and kept is not None:
            made.occupancy.kept[made.occupancy.rows(made.space.unit_cube(kept)).long()] = True
        return cls(made.to(device), _adam(made, settings), generator)

    def checkpoint(self, made_with: Mapping[str, Any]) -> Checkpoint:
        """Return all of this, with what the run was started with.

        Raises
        ------
        NumericalError
            Where something is not finite: such a state is never written over a good one.
        """
        tensors = {f"field.{name}": tensor for name, tensor in self.field.tensors().items()}
        for number, parameter in enumerate(_parameters(self.field)):
            for name, value in self.optimiser.state[parameter].items():
                tensors[f"adam.{number}.{name}"] = value
        tensors |= {f"occupancy.{name}": tensor for name, tensor in self.field.occupancy_tensors().items()}
        for name, tensor in tensors.items():
            if not bool(torch.isfinite(tensor).all()):
                raise NumericalError(
                    f"Training met '{name}' that is not finite at step {self.step}",
                    expected="finite numbers",
                    todo="Lower the learning rate; the last checkpoint before this step is kept",
                )
        tensors["generator"] = self.generator.get_state()
        state = {
            "made_with": dict(made_with),
            "space": self.field.space.to_dict(),
            "history": [[row.step, row.loss, row.depth_loss, row.psnr_test] for row in self.history],
            "seconds": self.seconds,
            "per_ray": self.per_ray,
        }
        return Checkpoint(self.step, tensors, state)

    @classmethod
    def resume(cls, saved: Checkpoint, settings: NerfSettings, device: str, source: Path) -> NerfState:
        """Return the state that :meth:`checkpoint` wrote down into ``source``."""
        generator = torch.Generator()
        made = RadianceField(settings, Space.from_dict(saved.state["space"]), generator)
        named = {n.removeprefix("field."): t for n, t in saved.tensors.items() if n.startswith("field.")}
        set_tensors(made, named, source)
        made.to(device)
        optimiser = _adam(made, settings)
        for number, parameter in enumerate(_parameters(made)):
            names = ("step", "exp_avg", "exp_avg_sq")
            moments = {name: saved.tensors.get(f"adam.{number}.{name}") for name in names}
            if moments["step"] is not None:
                optimiser.state[parameter] = {
                    name: value if name == "step" else value.to(device)
                    for name, value in moments.items()
                    if value is not None
                }
        made.set_occupancy(
            {n.removeprefix("occupancy."): t for n, t in saved.tensors.items() if n.startswith("occupancy.")}
        )
        generator.set_state(saved.tensors["generator"])
        state = saved.state
        history = [NerfRow(*row) for row in state["history"]]
        return cls(
            made,
            optimiser,
            generator,
            step=saved.step,
            history=history,
            seconds=dict(state["seconds"]),
            per_ray=float(state["per_ray"]),
        )


def _parameters(field: RadianceField) -> list[torch.nn.Parameter]:
    return [parameter for network in field.networks() for parameter in network.parameters()]


def _adam(field: RadianceField, settings: NerfSettings) -> torch.optim.Adam:
    return torch.optim.Adam(
        _parameters(field), lr=settings.lr, betas=(0.9, settings.beta2), eps=settings.epsilon, fused=True
    )
