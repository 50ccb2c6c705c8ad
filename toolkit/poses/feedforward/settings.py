"""Settings of feed-forward networks. Importing this loads no network and no numerical library."""

from __future__ import annotations

from toolkit.settings import Boolean, Choice, Integer, Number, Settings, Text


class FeedForwardSettings(Settings):
    """Which network says where cameras and surfaces are."""

    provider = Choice(
        "vggt",
        choices=("vggt", "dust3r", "mast3r", "depth-anything-3", "file"),
        doc="VGGT, DUSt3R, MASt3R or Depth Anything 3, where installed; file: predictions.npz that was computed "
        "elsewhere.",
    )
    weights = Text(
        "",
        doc="File or folder of the network's weights, or their name on the Hugging Face hub. Empty: "
        "facebook/VGGT-1B, naver/DUSt3R_ViTLarge_BaseDecoder_512_dpt, "
        "naver/MASt3R_ViTLarge_BaseDecoder_512_catmlpdpt_metric or depth-anything/DA3-LARGE.",
    )
    download = Boolean(False, doc="Fetch missing weights from the hub.")
    device = Choice("cpu", choices=("cpu", "cuda"), doc="Where the network computes.")
    file = Text("", doc="Path of predictions.npz, for the provider file.")
    fit = Choice(
        "crop",
        choices=("crop", "pad"),
        doc="VGGT: of pictures that are taller than wide, the middle square is taken; pad: they are kept whole.",
    )
    points = Choice(
        "depth",
        choices=("depth", "head"),
        doc="VGGT: points from depth and cameras, or those of its point head.",
    )
    side = Integer(504, bounds=(56, 4096), unit="px", doc="Depth Anything 3: longer side of the scaled pictures.")
    pairs = Choice(
        "complete",
        choices=("complete", "swin-3", "swin-5", "logwin-3", "oneref-0"),
        doc="DUSt3R and MASt3R: which pairs of pictures are compared, in their words: all; neighbours in order; "
        "neighbours 1, 2, 4 apart; the first with all others.",
    )
    steps = Integer(300, bounds=(1, 10000), doc="DUSt3R and MASt3R: steps of the global alignment.")
    rate = Number(0.01, bounds=(1e-6, 1.0), doc="DUSt3R and MASt3R: learning rate of the global alignment.")
