"""The optimiser of Gaussians: Adam, learning rates, and rows that come and go."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import torch
from torch import Tensor

from toolkit.errors import NumericalError, RunError
from toolkit.splat.adam import adam_update
from toolkit.splat.gaussians import Gaussians
from toolkit.splat.train_settings import TrainSettings, means_rate


class GaussianOptimiser:
    """Gaussians that are being trained, with Adam's moments for each of their values.

    Attributes
    ----------
    gaussians:
        The parameters, leaves that ask for gradients. :meth:`rearrange` and :meth:`raise_sh_degree` replace them.
    first, second:
        Moments by the parameter's name, of its shape.
    origins:
        (N, 3) where each Gaussian began; copies have the origin of what they are copies of.
    """

    def __init__(self, gaussians: Gaussians) -> None:
        self.gaussians = _leaves(gaussians)
        self.origins = gaussians.means.detach().clone()
        self.first = {name: torch.zeros_like(tensor) for name, tensor in gaussians.named()}
        self.second = {name: torch.zeros_like(tensor) for name, tensor in gaussians.named()}

    def step(self, settings: TrainSettings, extent: float, step: int, *, drawn: Tensor | None = None) -> None:
        """Move every parameter against its gradient, and forget the gradients.

        Parameters
        ----------
        settings:
            Hold the learning rates.
        extent:
            Of the scene, by which the rate of the centres is multiplied.
        step:
            Number of this step, from 1 on.
        drawn:
            (N,) bool: the others rest, with their moments; None: all move.

        Raises
        ------
        NumericalError
            Where a gradient or a parameter is not finite; the message names it and the step.
        """
        for name, parameter in self.gaussians.named():
            gradient = parameter.grad if parameter.grad is not None else torch.zeros_like(parameter)
            rates = _rates(name, parameter, settings, extent, step)
            if not adam_update(parameter, gradient, self.first[name], self.second[name], rates, step, drawn):
                require_finite(f"the gradient of {name}", gradient, step)
                require_finite(name, parameter, step)
            parameter.grad = None

    def rearrange(self, source: Tensor, fresh: int) -> None:
        """Replace the Gaussians by copies of rows ``source`` (M,) int64; the last ``fresh`` have zero moments."""
        self.gaussians = _leaves(self.gaussians.detach().map(lambda tensor: tensor[source]))
        self.origins = self.origins[source]
        for moments in (self.first, self.second):
            for name, tensor in moments.items():
                moments[name] = tensor[source]
                moments[name][len(source) - fresh :] = 0

    def raise_sh_degree(self, degree: int) -> None:
        """Add zero coefficients up to ``degree``; nothing happens where there are already that many."""
        missing = (degree + 1) ** 2 - self.gaussians.sh.shape[1]
        if missing <= 0:
            return

        def widen(sh: Tensor) -> Tensor:
            return torch.cat([sh.detach(), sh.new_zeros(len(sh), missing, 3)], dim=1)

        self.gaussians = _leaves(replace(self.gaussians, sh=widen(self.gaussians.sh)))
        for moments in (self.first, self.second):
            moments["sh"] = widen(moments["sh"])

    def set_opacities_back(self, ceiling: float) -> None:
        """Lower opacities to at most ``ceiling`` and forget their moments (Kerbl et al. 2023, section 5.2)."""
        with torch.no_grad():
            logits = self.gaussians.opacity_logits
            logits.clamp_(max=float(torch.logit(torch.tensor(ceiling))))
        self.first["opacity_logits"].zero_()
        self.second["opacity_logits"].zero_()

    def tensors(self) -> dict[str, Tensor]:
        """Return everything that a checkpoint must hold."""
        return {
            **{f"gaussians.{name}": tensor.detach() for name, tensor in self.gaussians.named()},
            **{f"first.{name}": tensor for name, tensor in self.first.items()},
            **{f"second.{name}": tensor for name, tensor in self.second.items()},
            "origins": self.origins,
        }

    @classmethod
    def from_tensors(cls, tensors: Mapping[str, Tensor]) -> GaussianOptimiser:
        """Return the optimiser that :meth:`tensors` described.

        Raises
        ------
        RunError
            Where an earlier version wrote them, which did not know where Gaussians began.
        """
        if "origins" not in tensors:
            raise RunError(
                "The checkpoint is of an earlier version",
                expected="where each Gaussian began (origins)",
                found=", ".join(sorted(tensors)),
                todo="Start a new run",
            )
        groups: dict[str, dict[str, Tensor]] = {"gaussians": {}, "first": {}, "second": {}}
        for key, tensor in tensors.items():
            group, _, name = key.partition(".")
            if group in groups:
                groups[group][name] = tensor
        made = cls(Gaussians(**groups["gaussians"]))
        made.first, made.second, made.origins = groups["first"], groups["second"], tensors["origins"]
        return made


def _leaves(gaussians: Gaussians) -> Gaussians:
    return gaussians.map(lambda tensor: tensor.detach().contiguous().requires_grad_())


def _rates(name: str, parameter: Tensor, settings: TrainSettings, extent: float, step: int) -> Tensor:
    """Return learning rates of the shape of one row of the parameter."""
    rates = torch.ones_like(parameter[0], requires_grad=False)
    if name == "sh":
        rates *= settings.lr_sh_rest
        rates[0] = settings.lr_sh0
        return rates
    if name == "means":
        return rates * (means_rate(settings, step) * extent)
    by_name = {
        "quaternions": settings.lr_quaternions,
        "log_scales": settings.lr_log_scales,
        "opacity_logits": settings.lr_opacity,
    }
    return rates * by_name[name]


def require_finite(what: str, tensor: Tensor, step: int) -> None:
    """Raise :class:`NumericalError` where a tensor has NaN or infinities; ``what`` names it."""
    bad = int((~torch.isfinite(tensor.detach())).sum())
    if bad:
        raise NumericalError(
            f"Training met values that are not finite in {what} at step {step}",
            expected="finite numbers",
            found=f"{bad} of {tensor.numel()} NaN or infinite",
            todo="Lower the learning rates; the last checkpoint before this step is kept",
        )
