"""An affine change of colours for each training photo: exposure and white balance that vary between photos.

Photo i is compared with ``A_i c + b_i`` of the render c. That leaves a freedom: any one change of colours could be
taken from all photos and given to the Gaussians. It is fixed by holding the mean over the training photos at the
identity exactly, so the Gaussians get the mean exposure, and that is how photos are drawn which were not trained
on. One photo as the reference would do, too, but then the whole splat would look like that one, however dark.

As in the code of Kerbl et al. (their "exposure compensation"), with another choice of what is fixed.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import torch
from torch import Tensor

from toolkit.errors import NumericalError
from toolkit.splat.adam import adam_update


@dataclass
class Exposure:
    """Colour changes of F photos, with Adam's moments.

    Attributes
    ----------
    affine:
        (F, 3, 4) float32: columns 0 to 2 are multiplied with the colour, column 3 is added.
    first, second:
        (F, 3, 4) moments.
    count:
        (F,) int64, how often each photo was seen.
    """

    affine: Tensor
    first: Tensor
    second: Tensor
    count: Tensor

    @classmethod
    def start(cls, photos: int, device: str) -> Exposure:
        """Return no change for any photo."""
        affine = torch.eye(3, 4, device=device).repeat(photos, 1, 1)
        return cls(
            affine, torch.zeros_like(affine), torch.zeros_like(affine), torch.zeros(photos, dtype=torch.int64)
        )

    def tensors(self) -> dict[str, Tensor]:
        """Return everything that a checkpoint must hold."""
        return {
            "exposure.affine": self.affine,
            "exposure.first": self.first,
            "exposure.second": self.second,
            "exposure.count": self.count,
        }

    @classmethod
    def from_tensors(cls, tensors: Mapping[str, Tensor], device: str) -> Exposure:
        """Return what :meth:`tensors` described."""
        affine, first, second = (tensors[f"exposure.{name}"].to(device) for name in ("affine", "first", "second"))
        return cls(affine, first, second, tensors["exposure.count"])

    def of_photo(self, index: int) -> Tensor:
        """Return the colour change (3, 4) of a photo, a leaf that asks for a gradient."""
        return self.affine[index].clone().requires_grad_()

    def step(self, index: int, gradient: Tensor, rate: float, step: int) -> None:
        """Move a photo's change against its gradient (3, 4), then hold the mean of all at the identity.

        Raises
        ------
        NumericalError
            Where gradient or change are not finite; ``step`` is for the message.
        """
        row = slice(index, index + 1)
        self.count[index] += 1
        rates = torch.full_like(gradient, rate)
        finite = adam_update(
            self.affine[row], gradient[None], self.first[row], self.second[row], rates, int(self.count[index])
        )
        if not finite:
            raise NumericalError(
                f"Training met values that are not finite in the exposure of photo {index} at step {step}",
                expected="finite numbers",
                todo="Lower the learning rates; the last checkpoint before this step is kept",
            )
        self.affine -= self.affine.mean(dim=0) - torch.eye(3, 4, device=self.affine.device)


def expose(colours: Tensor, affine: Tensor) -> Tensor:
    """Return colours (H, W, 3) changed by an affine map (3, 4)."""
    return colours @ affine[:, :3].T + affine[:, 3]
