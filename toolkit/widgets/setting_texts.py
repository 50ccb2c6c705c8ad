"""What is said of a setting beside its widget, on pages and in notebooks alike."""

from __future__ import annotations

from toolkit.settings import SettingRow, Settings


def group_of(name: str) -> str:
    """Return the first part of a dotted name, empty for a setting that is in no group."""
    return name.partition(".")[0] if "." in name else ""


def group_title(group: str, settings_type: type[Settings]) -> str:
    """Return what a group is called."""
    return (settings_type.declaration(group).doc or group) if group else "General"


def setting_label(row: SettingRow) -> str:
    """Return a setting's name within its group, with its unit."""
    inside = row.name.partition(".")[2] or row.name
    label = inside.replace("_", " ").replace(".", ": ")
    # "max features (features)" would say it twice.
    return label + (f" ({row.unit})" if row.unit and not label.endswith(row.unit) else "")


def setting_help(row: SettingRow) -> str:
    """Return what a setting does, what it may be and what it is by default."""
    unit = f" {row.unit}" if row.unit else ""
    return f"{row.doc} {row.allowed[:1].upper()}{row.allowed[1:]}; default {row.default}{unit}."
