"""Declared settings: one declaration gives defaults, validation, JSON, command-line flags and tables.

A stage declares a subclass of :class:`Settings`::

    class SiftSettings(Settings):
        max_features = Integer(8192, bounds=(16, 65536), unit="features", doc="Most features kept per image.")

Recipes nest the settings of their stages with :class:`Group`; dotted names (``sift.max_features``) reach them.
"""

from __future__ import annotations

import argparse
import difflib
import json
import math
import numbers
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any, Self

import param

from toolkit.errors import SettingsError


class Number(param.Number):
    """A finite real number with bounds and unit."""

    def __init__(self, default: float, *, unit: str = "", **kwargs: Any) -> None:
        super().__init__(default, metadata={"unit": unit}, **kwargs)


class Integer(param.Integer):
    """A whole number with bounds and unit."""

    def __init__(self, default: int, *, unit: str = "", **kwargs: Any) -> None:
        super().__init__(default, metadata={"unit": unit}, **kwargs)


class Boolean(param.Boolean):
    """Yes or no."""


class Choice(param.Selector):
    """One of a fixed list of names."""

    def __init__(self, default: str, *, choices: Iterable[str], **kwargs: Any) -> None:
        super().__init__(default=default, objects=list(choices), **kwargs)


class Text(param.String):
    """A line of text, for example a path; the empty text means "not given"."""


class Group(param.ClassSelector):
    """The settings of one stage inside those of a recipe."""

    def __init__(self, default: Settings, **kwargs: Any) -> None:
        super().__init__(class_=type(default), default=default, instantiate=True, **kwargs)

    @property
    def settings_type(self) -> type[Settings]:
        """The class of the nested settings."""
        assert isinstance(self.class_, type)
        assert issubclass(self.class_, Settings)
        return self.class_


@dataclass(frozen=True, slots=True)
class SettingRow:
    """One line of a settings table."""

    name: str
    default: Any
    allowed: str
    unit: str
    doc: str


class Settings(param.Parameterized):
    """Base of all settings.

    Unlike plain param it refuses attributes that were not declared, booleans given as numbers, NaN, infinities
    and functions given as values.

    Raises
    ------
    SettingsError
        At construction and assignment; the message names the setting, what it takes and what it got.
    """

    def __init__(self, **values: Any) -> None:
        for name in values:
            self._declared(name)
        object.__setattr__(self, "_frozen", False)
        super().__init__()
        for name, value in values.items():
            setattr(self, name, value)

    @classmethod
    def _names(cls) -> list[str]:
        return [name for name in cls.param if name != "name"]

    @classmethod
    def _declared(cls, name: str) -> param.Parameter:
        names = cls._names()
        if name not in names:
            close = difflib.get_close_matches(str(name), names, n=1)
            raise SettingsError(
                f"Unknown setting '{name}' of {cls.__name__}",
                expected="one of " + ", ".join(names),
                todo=f"Did you mean '{close[0]}'?" if close else "",
            )
        return cls.param[name]

    def __setattr__(self, name: str, value: Any) -> None:
        if name.startswith("_param__") or name in {"param", "name"} or "_frozen" not in self.__dict__:
            super().__setattr__(name, value)
            return
        declared = self._declared(name)
        if self.__dict__["_frozen"]:
            raise SettingsError(
                f"Setting '{name}' belongs to a started job and cannot change",
                todo="Make a changed copy with replace()",
            )
        try:
            super().__setattr__(name, _checked(name, declared, value))
        except (ValueError, TypeError) as error:
            raise SettingsError(
                f"Setting '{name}' is out of range or of the wrong type",
                expected=_allowed(declared),
                found=repr(value),
            ) from error

    def items(self) -> Iterator[tuple[str, Any]]:
        """Yield ``(dotted name, value)`` of every setting, nested ones included, in order of declaration."""
        for name in self._names():
            value = getattr(self, name)
            if isinstance(value, Settings):
                for inner, item in value.items():
                    yield f"{name}.{inner}", item
            else:
                yield name, value

    def to_dict(self) -> dict[str, Any]:
        """Return the values as nested plain dictionaries, ready for JSON."""
        return {
            name: value.to_dict() if isinstance(value, Settings) else value
            for name, value in ((name, getattr(self, name)) for name in self._names())
        }

    @classmethod
    def from_dict(cls, values: Mapping[str, Any]) -> Self:
        """Return settings from nested dictionaries; what is not named keeps its default.

        Raises
        ------
        SettingsError
            For an unknown key, a value of the wrong type or out of range.
        """
        if not isinstance(values, Mapping):
            raise SettingsError(
                f"Settings of {cls.__name__} are not a table", expected="names and values", found=repr(values)
            )
        made = cls()
        made._update(values)
        return made

    def _update(self, values: Mapping[str, Any]) -> None:
        for name, value in values.items():
            if isinstance(self._declared(name), Group) and isinstance(value, Mapping):
                try:
                    getattr(self, name)._update(value)
                except SettingsError as error:
                    raise SettingsError(f"In '{name}': {error}") from error
            elif isinstance(value, Settings):
                setattr(self, name, type(value).from_dict(value.to_dict()))
            else:
                setattr(self, name, value)

    def to_json(self) -> str:
        """Return the values as JSON text."""
        return json.dumps(self.to_dict(), indent=2, sort_keys=True, allow_nan=False)

    @classmethod
    def from_json(cls, text: str) -> Self:
        """Return settings from JSON text. Raises :class:`SettingsError` as :meth:`from_dict` does."""
        try:
            values = json.loads(text)
        except json.JSONDecodeError as error:
            raise SettingsError(
                "Settings are not JSON", expected="an object of names and values", found=str(error)
            ) from error
        return cls.from_dict(values)

    def replace(self, changes: Mapping[str, Any]) -> Self:
        """Return a copy with ``changes``, a mapping of dotted names to values. The copy is not frozen.

        The value of a group is a mapping of those of its settings that change, or a whole settings object.
        """
        made = type(self).from_dict(self.to_dict())
        for dotted, value in changes.items():
            *path, last = dotted.split(".")
            target: Settings = made
            for part in path:
                if not isinstance(target._declared(part), Group):
                    raise SettingsError(f"Setting '{part}' in '{dotted}' has no settings below it")
                target = getattr(target, part)
            try:
                target._update({last: value})
            except SettingsError as error:
                if not path:
                    raise
                raise SettingsError(f"In '{'.'.join(path)}': {error}") from error
        return made

    def replace_from_text(self, assignments: Iterable[str]) -> Self:
        """Return a copy changed by texts of the form ``key=value`` as they come from a command line."""
        changes: dict[str, Any] = {}
        for assignment in assignments:
            key, equals, text = assignment.partition("=")
            if not equals:
                raise SettingsError(f"Cannot read '{assignment}'", expected="key=value")
            changes[key.strip()] = _from_text(self.declaration(key.strip()), key.strip(), text.strip())
        return self.replace(changes)

    @classmethod
    def declaration(cls, dotted: str) -> param.Parameter:
        """Return how a setting is declared. Raises :class:`SettingsError` where there is no such one."""
        *path, last = dotted.split(".")
        kind: type[Settings] = cls
        for part in path:
            group = kind._declared(part)
            if not isinstance(group, Group):
                raise SettingsError(f"Setting '{part}' in '{dotted}' has no settings below it")
            kind = group.settings_type
        return kind._declared(last)

    def frozen(self) -> Self:
        """Return a deep copy that refuses every change: what a job is given."""
        copy = type(self).from_dict(self.to_dict())
        copy._freeze()
        return copy

    def _freeze(self) -> None:
        for name in self._names():
            value = getattr(self, name)
            if isinstance(value, Settings):
                value._freeze()
        self.__dict__["_frozen"] = True

    def differences(self, other: Settings) -> dict[str, tuple[Any, Any]]:
        """Return dotted names whose values differ, each with this and the other's value (None: absent)."""
        mine, others = dict(self.items()), dict(other.items())
        return {
            name: (mine.get(name), others.get(name))
            for name in dict.fromkeys([*mine, *others])
            if mine.get(name) != others.get(name)
        }

    @classmethod
    def table(cls, prefix: str = "") -> list[SettingRow]:
        """Return one row for each setting, nested ones under dotted names. Defaults are those of ``cls``."""
        rows: list[SettingRow] = []
        for name in cls._names():
            declared = cls.param[name]
            if isinstance(declared, Group):
                inner_defaults = dict(declared.default.items())
                for row in declared.settings_type.table():
                    default = inner_defaults[row.name]
                    dotted = f"{prefix}{name}.{row.name}"
                    rows.append(SettingRow(dotted, default, row.allowed, row.unit, row.doc))
            else:
                unit = (declared.metadata or {}).get("unit", "")
                doc = " ".join((declared.doc or "").split())
                rows.append(SettingRow(prefix + name, declared.default, _allowed(declared), unit, doc))
        return rows

    @classmethod
    def add_flags(cls, parser: argparse.ArgumentParser) -> None:
        """Add one ``--name`` flag for each setting; read them back with :meth:`from_flags`."""
        for row in cls.table():
            unit = f" {row.unit}" if row.unit else ""
            value, said = _flag_value(cls.declaration(row.name), row.allowed)
            parser.add_argument(
                "--" + row.name.replace("_", "-"),
                dest=_FLAG + row.name,
                metavar=value,
                help=f"{row.doc} [{row.default}{unit}{said}]".replace("%", "%%"),
            )

    @classmethod
    def from_flags(cls, arguments: argparse.Namespace) -> Self:
        """Return settings from what a parser prepared by :meth:`add_flags` read."""
        given = {
            key.removeprefix(_FLAG): text
            for key, text in vars(arguments).items()
            if key.startswith(_FLAG) and text is not None
        }
        return cls().replace_from_text(f"{name}={text}" for name, text in given.items())


_FLAG = "setting:"


def _flag_value(declared: param.Parameter, allowed: str) -> tuple[str, str]:
    """Return what stands for the value of a flag, and what its help says besides about the values it takes."""
    if isinstance(declared, param.Boolean):
        return "true|false", ""
    if isinstance(declared, param.Selector):
        return allowed.replace(" ", ""), ""
    if isinstance(declared, param.Number):
        return "INTEGER" if isinstance(declared, param.Integer) else "NUMBER", f"; {allowed}"
    return "TEXT", ""


def _checked(name: str, declared: param.Parameter, value: Any) -> Any:
    """Return the value as a plain Python number where it is one; refuse what param lets pass."""
    wrong = callable(value)
    if isinstance(declared, param.Number) and not wrong:
        # numpy's scalars are numbers too, but JSON does not take them; its bools and arrays are none.
        wrong = isinstance(value, bool) or not isinstance(value, numbers.Real) or not _is_finite(value)
        if not wrong:
            value = int(value) if isinstance(value, numbers.Integral) else float(value)
    if wrong:
        raise SettingsError(
            f"Setting '{name}' is out of range or of the wrong type",
            expected=_allowed(declared),
            found=repr(value),
        )
    return value


def _is_finite(value: numbers.Real) -> bool:
    try:
        return math.isfinite(value)
    except OverflowError:  # A whole number beyond the range of float.
        return False


def _allowed(declared: param.Parameter) -> str:
    """Say in a few words which values a parameter takes."""
    if isinstance(declared, param.Boolean):
        return "true or false"
    if isinstance(declared, param.Selector):
        return " | ".join(str(item) for item in declared.objects)
    if isinstance(declared, param.Number):
        kind = "whole number" if isinstance(declared, param.Integer) else "number"
        low, high = declared.bounds or (None, None)
        with_low, with_high = declared.inclusive_bounds
        if low is not None and high is not None and with_low and with_high:
            return f"{kind} {low} to {high}"
        above = "" if low is None else f" {'from' if with_low else 'above'} {low}"
        below = "" if high is None else f" {'up to' if with_high else 'below'} {high}"
        return kind + above + below
    if isinstance(declared, Group):
        return f"settings of {declared.settings_type.__name__}"
    return "text"


def _from_text(declared: param.Parameter, name: str, text: str) -> Any:
    """Convert command-line text to the type of the parameter."""
    words = {"true": True, "yes": True, "1": True, "false": False, "no": False, "0": False}
    try:
        if isinstance(declared, param.Boolean):
            return words[text.lower()]
        if isinstance(declared, param.Integer):
            return int(text)
        if isinstance(declared, param.Number):
            return float(text)
    except (ValueError, KeyError) as error:
        raise SettingsError(
            f"Setting '{name}' is out of range or of the wrong type",
            expected=_allowed(declared),
            found=repr(text),
        ) from error
    if isinstance(declared, Group):
        raise SettingsError(f"'{name}' is a group of settings", todo=f"Name one of them, as {name}.<setting>")
    return text
