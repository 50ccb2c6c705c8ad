"""What networks see of positions and directions."""

from __future__ import annotations

import math

import torch

from toolkit.nerf.encoding import frequency_encoding, harmonics
from toolkit.nerf.networks import FrequencyNetwork


def test_positions_come_with_sines_and_cosines_of_doubling_frequency() -> None:
    values = torch.tensor([[0.3, -1.2]], dtype=torch.float64)
    encoded = frequency_encoding(values, 3)[0].tolist()
    wanted = [0.3, -1.2]
    for frequency in (1, 2, 4):
        wanted += [math.sin(frequency * v) for v in (0.3, -1.2)] + [math.cos(frequency * v) for v in (0.3, -1.2)]
    assert encoded == wanted


def test_harmonics_are_orthonormal_on_the_sphere() -> None:
    normal = torch.randn(400_000, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    values = harmonics(normal / normal.norm(dim=1, keepdim=True))
    gram = 4 * math.pi * values.T @ values / len(values)
    # By 400,000 random directions: a standard deviation of about 0.003.
    torch.testing.assert_close(gram, torch.eye(16, dtype=torch.float64), rtol=0, atol=0.02)


def test_the_papers_network_has_its_size() -> None:
    network = FrequencyNetwork(torch.Generator().manual_seed(0))
    # 63 -> 256, 3 x 256, 319 -> 256, 3 x 256; 256 -> 1; 256 -> 256; 283 -> 128; 128 -> 3; with biases.
    layers = 64 * 256 + 6 * 257 * 256 + 320 * 256
    assert sum(p.numel() for p in network.parameters()) == layers + 257 + 257 * 256 + 284 * 128 + 129 * 3
