"""The root of every exception that the toolkit raises on purpose."""

from __future__ import annotations


class ToolkitError(Exception):
    """Something the user can understand and mend.

    Parameters
    ----------
    what:
        What went wrong, in one clause, naming the file, key or stage.
    expected, found, todo:
        What was expected, what was found instead, and what to do about it. Those that are given are
        joined into one message.
    """

    def __init__(self, what: str, *, expected: str = "", found: str = "", todo: str = "") -> None:
        parts = [what.rstrip(".")]
        if expected:
            parts.append(f"expected {expected}")
        if found:
            parts.append(f"found {found}")
        message = "; ".join(parts) + "."
        if todo:
            message += f" {todo}" if todo.endswith((".", "?")) else f" {todo}."
        super().__init__(message)


class DataError(ToolkitError):
    """Input data (picture, PLY, COLMAP model, JSON) is missing, damaged or contradicts itself."""


class SettingsError(ToolkitError):
    """A setting is unknown, has the wrong type or is out of its range."""


class StageError(ToolkitError):
    """A stage could not do its work on sound input, with the reason (for example: no overlap)."""


class CapabilityError(ToolkitError):
    """A backend was asked for something that it cannot do. Nothing is substituted."""


class MissingDependencyError(ToolkitError):
    """An optional package or a model file is missing; the message names what installs it."""


class WeightsMissingError(MissingDependencyError):
    """The weights of a network are not on this machine; the message says what was looked for and what mends it."""


class RunError(ToolkitError):
    """A run folder is in use, damaged or not what the command needs."""


class NumericalError(ToolkitError):
    """NaN or infinity in a loss, a parameter or a gradient; the message names the tensor."""


class Cancelled(ToolkitError):
    """The user asked the running job to stop."""
