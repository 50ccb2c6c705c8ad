"""Networks of the ``transformers`` package, from a folder or the hub: safetensors only, no code of a model runs."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from toolkit.errors import DataError, WeightsMissingError


def load_pretrained(kind: Any, weights: str, *, what: str, files: str, download: bool, **options: Any) -> Any:
    """Return ``kind.from_pretrained(weights)``; whatever goes wrong is told as one of our errors.

    Parameters
    ----------
    kind:
        A class of transformers.
    weights:
        Folder as ``save_pretrained`` writes it, or a name on the Hugging Face hub.
    what:
        The network for messages, as "depth network".
    files:
        What its folder holds, for messages.
    download:
        Fetch what is missing from the hub.
    options:
        Passed on.

    Raises
    ------
    WeightsMissingError
        Where there are no weights.
    DataError
        For damaged files.
    """
    from safetensors import SafetensorError

    known = {"local_files_only": not download, "trust_remote_code": False, **options}
    try:
        return kind.from_pretrained(weights, **known)
    except SafetensorError as error:
        raise _damaged(weights, what, files, error) from error
    except (OSError, ValueError, RuntimeError, KeyError, TypeError) as error:
        # A missing file of the hub is an OSError; of a folder that is there, it is damage.
        if Path(weights).is_dir() or not isinstance(error, OSError):
            raise _damaged(weights, what, files, error) from error
        looked = (
            "the Hugging Face hub and its cache" if download else "the Hugging Face cache (no download was asked)"
        )
        ask = "" if download else "or set download, "
        raise WeightsMissingError(
            f"Weights missing: no '{weights}' as safetensors",
            expected=f"a folder of this name, or the network in {looked}",
            found=_line(error),
            todo=f"Run: {download_command(weights)}, {ask}or set weights to a folder that has it",
        ) from error


def download_command(name: str, folder: Path | None = None) -> str:
    """Return the command that fetches a network of the hub."""
    return f"hf download {name}" + (f" --local-dir {folder}" if folder is not None else "")


def require_complete(weights: str, info: dict[str, Any], *, unused: tuple[str, ...] = ()) -> None:
    """Raise where a file lacks weights; those of another shape transformers itself refuses.

    Parameters
    ----------
    info:
        What ``from_pretrained`` returns with ``output_loading_info``.
    unused:
        Beginnings of the names of weights that are never used.

    Raises
    ------
    DataError
        Transformers would fill them with random numbers.
    """
    missing = sorted(name for name in info["missing_keys"] if not name.startswith(unused))
    if missing:
        raise DataError(
            f"The file of '{weights}' does not hold all weights of the network",
            expected="every weight",
            found=f"{len(missing)} missing: " + ", ".join(missing[:3]),
            todo="Get its files again",
        )


def _damaged(weights: str, what: str, files: str, error: Exception) -> DataError:
    return DataError(
        f"The {what} in '{weights}' cannot be loaded",
        expected=files,
        found=_line(error),
        todo="Get its files again",
    )


def _line(error: Exception) -> str:
    """Return the first sentence or so of a long message, on one line."""
    text = " ".join(str(error).split()) or type(error).__name__
    return text if len(text) <= 300 else text[:300] + "..."
