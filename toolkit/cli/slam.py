"""Commands on simultaneous localisation and mapping."""

from __future__ import annotations

import argparse
from pathlib import Path

from toolkit.cli.common import add, with_bar


def add_commands(commands: argparse._SubParsersAction, *, with_vocabulary_flags: bool) -> None:
    """Add all commands on SLAM."""
    added = add(
        commands,
        "vocabulary",
        _vocabulary,
        "Train the visual words that ORB-SLAM3 needs from a folder of pictures.",
        "vocabulary photos/ words.txt --levels 6",
    )
    added.add_argument("pictures", type=Path, metavar="PICTURES_FOLDER", help="pictures, also in folders below it")
    added.add_argument("out", type=Path, metavar="OUT", help="file to write")
    added.add_argument("--seed", type=int, default=0, help="of every random choice [0]")
    if with_vocabulary_flags:
        from toolkit.poses.slam.vocabulary import VocabularySettings

        VocabularySettings.add_flags(added)


def _vocabulary(arguments: argparse.Namespace) -> None:
    from toolkit.poses.slam.vocabulary import VocabularySettings, pictures_below, train_vocabulary

    settings = VocabularySettings.from_flags(arguments)
    pictures = pictures_below(arguments.pictures)
    report = with_bar(
        lambda bar: train_vocabulary(pictures, arguments.out, settings, seed=arguments.seed, progress=bar)
    )
    print(
        f"{arguments.out}: {report.words} words from {report.descriptors} features of {report.pictures} pictures "
        f"in {report.seconds:.0f} s"
    )
