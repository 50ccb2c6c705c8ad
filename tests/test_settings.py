"""Settings: what they refuse, and that every way in and out keeps the values."""

from __future__ import annotations

import argparse
import copy
import json
import math
import pickle
import string
from decimal import Decimal
from fractions import Fraction
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from toolkit.errors import SettingsError
from toolkit.settings import Boolean, Choice, Group, Integer, Number, Settings, Text


class Matcher(Settings):
    max_features = Integer(8192, bounds=(16, 65536), unit="features", doc="Most features kept per image.")
    ratio = Number(0.8, bounds=(0.0, 1.0), doc="Lowe's ratio,\n    at most.")
    guided = Boolean(False, doc="Match again along epipolar lines.")
    kind = Choice("sift", choices=["sift", "disk"], doc="Which features.")
    weights = Text("", doc="Path of the weights.")


class Mapper(Settings):
    matcher = Group(Matcher(max_features=2048, ratio=0.7), doc="Matching.")
    offset = Number(0.0, unit="m", doc="Shift, 50 % of it at least.")
    growth = Number(1.5, bounds=(1.0, None), inclusive_bounds=(False, True))
    floor = Number(-1.0, bounds=(None, 0.0))


class Recipe(Settings):
    mapper = Group(Mapper(offset=2.0))
    steps = Integer(10, bounds=(1, 100))


matchers = st.fixed_dictionaries(
    {},
    optional={
        "max_features": st.integers(16, 65536),
        "ratio": st.floats(0.0, 1.0),
        "guided": st.booleans(),
        "kind": st.sampled_from(["sift", "disk"]),
        "weights": st.text(),
    },
)
recipes = st.fixed_dictionaries(
    {},
    optional={
        "steps": st.integers(1, 100),
        "mapper": st.fixed_dictionaries({}, optional={"offset": st.floats(-1e300, 1e300), "matcher": matchers}),
    },
)


def test_defaults_are_the_declared_ones() -> None:
    assert Matcher().to_dict() == {
        "max_features": 8192,
        "ratio": 0.8,
        "guided": False,
        "kind": "sift",
        "weights": "",
    }


def test_constructor_takes_values() -> None:
    assert Matcher(ratio=0.5, kind="disk").to_dict() == {**Matcher().to_dict(), "ratio": 0.5, "kind": "disk"}


@pytest.mark.parametrize(
    "how",
    [
        lambda: Matcher(max_feature=3),
        lambda: setattr(Matcher(), "max_feature", 3),
        lambda: Matcher.from_dict({"max_feature": 3}),
        lambda: Matcher.from_json('{"max_feature": 3}'),
        lambda: Matcher().replace({"max_feature": 3}),
        lambda: Matcher().replace_from_text(["max_feature=3"]),
    ],
)
def test_misspelt_setting_is_refused_with_a_suggestion(how: Any) -> None:
    with pytest.raises(SettingsError) as caught:
        how()
    assert str(caught.value) == (
        "Unknown setting 'max_feature' of Matcher; expected one of max_features, ratio, guided, kind, weights. "
        "Did you mean 'max_features'?"
    )


def test_unknown_setting_unlike_any_other_gets_no_suggestion() -> None:
    with pytest.raises(SettingsError) as caught:
        Matcher(zzz=1)
    assert str(caught.value).endswith("kind, weights.")


def test_key_that_is_no_text_is_unknown_too() -> None:
    with pytest.raises(SettingsError, match="Unknown setting '3' of Matcher"):
        Matcher.from_dict({3: 1})


@pytest.mark.parametrize(
    ("name", "value", "allowed"),
    [
        ("max_features", 15, "whole number 16 to 65536"),
        ("max_features", 65537, "whole number 16 to 65536"),
        ("max_features", 100.0, "whole number 16 to 65536"),
        ("max_features", True, "whole number 16 to 65536"),
        ("max_features", "100", "whole number 16 to 65536"),
        ("max_features", None, "whole number 16 to 65536"),
        ("max_features", np.array(100), "whole number 16 to 65536"),
        ("ratio", -0.1, "number 0.0 to 1.0"),
        ("ratio", True, "number 0.0 to 1.0"),
        ("ratio", math.nan, "number 0.0 to 1.0"),
        ("ratio", lambda: 0.5, "number 0.0 to 1.0"),
        ("guided", 1, "true or false"),
        ("guided", "yes", "true or false"),
        ("guided", None, "true or false"),
        ("kind", "surf", "sift | disk"),
        ("kind", ["sift"], "sift | disk"),
        ("kind", None, "sift | disk"),
        ("weights", 3, "text"),
        ("weights", None, "text"),
        ("weights", str, "text"),
    ],
)
def test_wrong_value_is_refused_and_the_old_one_kept(name: str, value: Any, allowed: str) -> None:
    settings = Matcher()
    with pytest.raises(SettingsError) as caught:
        setattr(settings, name, value)
    assert str(caught.value) == (
        f"Setting '{name}' is out of range or of the wrong type; expected {allowed}; found {value!r}."
    )
    assert settings.to_dict() == Matcher().to_dict()


@pytest.mark.parametrize(
    "value",
    [
        math.nan,
        math.inf,
        -math.inf,
        np.float32("nan"),
        np.float64("inf"),
        np.bool_(True),
        np.array(1.0),
        np.array([1.0]),
        1j,
        Decimal(1),
        10**400,
    ],
)
def test_number_without_bounds_still_takes_finite_real_numbers_only(value: Any) -> None:
    with pytest.raises(
        SettingsError, match="Setting 'offset' is out of range or of the wrong type; expected number;"
    ):
        Mapper(offset=value)


@pytest.mark.parametrize(
    ("value", "plain"),
    [(np.float32(0.5), 0.5), (np.int64(1), 1), (np.uint8(1), 1), (Fraction(1, 4), 0.25), (np.float64(0.5), 0.5)],
)
def test_numbers_of_other_libraries_become_plain_ones(value: Any, plain: float) -> None:
    settings = Mapper(offset=value)
    assert type(settings.offset) is type(plain)
    assert settings.offset == plain
    assert json.loads(settings.to_json())["offset"] == plain


def test_exclusive_and_one_sided_bounds() -> None:
    with pytest.raises(SettingsError, match=r"expected number above 1\.0; found 1\.0"):
        Mapper(growth=1.0)
    with pytest.raises(SettingsError, match=r"expected number up to 0\.0; found 0\.1"):
        Mapper(floor=0.1)
    assert Mapper(floor=0.0).floor == 0.0


def test_group_takes_only_settings_of_its_type() -> None:
    with pytest.raises(SettingsError, match="expected settings of Matcher; found 3"):
        Mapper(matcher=3)
    with pytest.raises(SettingsError, match="expected settings of Matcher; found Recipe"):
        Mapper(matcher=Recipe())


def test_group_has_its_own_defaults_and_two_objects_share_none() -> None:
    first, second = Mapper(), Mapper()
    first.matcher.max_features = 100
    assert second.matcher.max_features == 2048
    assert Mapper().matcher.ratio == 0.7
    assert Matcher().ratio == 0.8


def test_partial_values_keep_the_defaults_of_the_group_at_every_depth() -> None:
    settings = Recipe.from_dict({"mapper": {"matcher": {"kind": "disk"}}})
    assert settings.mapper.matcher.kind == "disk"
    assert settings.mapper.matcher.max_features == 2048
    assert settings.mapper.offset == 2.0


def test_error_inside_a_group_names_the_groups() -> None:
    with pytest.raises(SettingsError, match="^In 'mapper': In 'matcher': Setting 'ratio' is out of range"):
        Recipe.from_dict({"mapper": {"matcher": {"ratio": 7}}})


def test_items_are_dotted_and_in_order_of_declaration() -> None:
    assert [name for name, _ in Recipe().items()] == [
        "mapper.matcher.max_features",
        "mapper.matcher.ratio",
        "mapper.matcher.guided",
        "mapper.matcher.kind",
        "mapper.matcher.weights",
        "mapper.offset",
        "mapper.growth",
        "mapper.floor",
        "steps",
    ]


@given(recipes)
def test_json_round_trip_keeps_every_value(values: dict[str, Any]) -> None:
    settings = Recipe.from_dict(values)
    again = Recipe.from_json(settings.to_json())
    assert again.to_dict() == settings.to_dict()
    assert settings.differences(again) == {}


@given(recipes)
def test_flags_round_trip_keeps_every_value(values: dict[str, Any]) -> None:
    settings = Recipe.from_dict(values)
    # Command lines cannot carry white space at the ends of a text.
    settings.mapper.matcher.weights = settings.mapper.matcher.weights.strip()
    parser = argparse.ArgumentParser()
    Recipe.add_flags(parser)
    line = [f"--{name.replace('_', '-')}={value}" for name, value in settings.items()]
    assert Recipe.from_flags(parser.parse_args(line)).to_dict() == settings.to_dict()


@given(st.dictionaries(st.text(string.ascii_lowercase, min_size=1), st.integers(), min_size=1))
def test_no_unknown_key_passes(values: dict[str, int]) -> None:
    declared = {"max_features", "ratio", "guided", "kind", "weights"}
    if set(values) & declared:
        values = {name: value for name, value in values.items() if name not in declared} | {"other": 1}
    with pytest.raises(SettingsError, match="Unknown setting"):
        Matcher.from_dict(values)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("{", "Settings are not JSON; expected an object of names and values; found Expecting property name"),
        ("[1]", r"Settings of Matcher are not a table; expected names and values; found \[1\]"),
        ('{"ratio": NaN}', "Setting 'ratio' is out of range or of the wrong type; expected number 0.0 to 1.0"),
        ('{"ratio": "0.5"}', "Setting 'ratio' is out of range or of the wrong type"),
        ('{"guided": 1}', "Setting 'guided' is out of range or of the wrong type"),
    ],
)
def test_unsound_json_is_refused(text: str, message: str) -> None:
    with pytest.raises(SettingsError, match=message):
        Matcher.from_json(text)


def test_replace_returns_a_copy_with_dotted_changes() -> None:
    before = Recipe()
    before.mapper.matcher.kind = "disk"
    after = before.replace({"mapper.matcher.ratio": 0.5, "steps": 3})
    assert before.differences(after) == {"mapper.matcher.ratio": (0.7, 0.5), "steps": (10, 3)}
    assert before.mapper.matcher.ratio == 0.7


def test_replace_of_a_group_by_a_mapping_keeps_what_it_does_not_name() -> None:
    before = Recipe().replace({"mapper.offset": 7.0})
    after = before.replace({"mapper": {"matcher": {"ratio": 0.5}}})
    assert before.differences(after) == {"mapper.matcher.ratio": (0.7, 0.5)}


def test_replace_of_a_group_by_settings_takes_a_copy() -> None:
    given_matcher = Matcher(kind="disk").frozen()
    after = Mapper().replace({"matcher": given_matcher})
    after.matcher.kind = "sift"
    assert given_matcher.kind == "disk"


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("steps.more", "Setting 'steps' in 'steps.more' has no settings below it"),
        ("mapper.offset.more", "Setting 'offset' in 'mapper.offset.more' has no settings below it"),
        ("mapper.nothing", "Unknown setting 'nothing' of Mapper"),
        ("nothing.offset", "Unknown setting 'nothing' of Recipe"),
    ],
)
def test_dotted_name_that_leads_nowhere_is_refused(name: str, message: str) -> None:
    with pytest.raises(SettingsError, match=message):
        Recipe().replace({name: 1})
    with pytest.raises(SettingsError, match=message):
        Recipe().replace_from_text([f"{name}=1"])


@pytest.mark.parametrize("text", ["true", "True", "yes", "1"])
def test_text_becomes_a_bool(text: str) -> None:
    assert Matcher().replace_from_text([f"guided={text}"]).guided is True


def test_text_becomes_the_type_of_the_setting() -> None:
    settings = Recipe().replace_from_text(
        ["steps = 7", "mapper.offset=-1e-3", "mapper.matcher.weights=a=b.pth", "mapper.matcher.guided=no"]
    )
    assert (settings.steps, settings.mapper.offset) == (7, -0.001)
    assert settings.mapper.matcher.weights == "a=b.pth"
    assert settings.mapper.matcher.guided is False


@pytest.mark.parametrize(
    ("assignment", "message"),
    [
        ("steps", "Cannot read 'steps'; expected key=value."),
        (
            "steps=7.5",
            "Setting 'steps' is out of range or of the wrong type; expected whole number 1 to 100; found '7.5'.",
        ),
        (
            "mapper.offset=near",
            "'mapper.offset' is out of range or of the wrong type; expected number; found 'near'.",
        ),
        ("mapper.offset=nan", "'offset' is out of range or of the wrong type; expected number; found nan."),
        ("mapper.matcher.guided=maybe", "expected true or false; found 'maybe'."),
        ("mapper=7", "'mapper' is a group of settings. Name one of them, as mapper.<setting>."),
    ],
)
def test_text_that_fits_no_setting_is_refused(assignment: str, message: str) -> None:
    with pytest.raises(SettingsError) as caught:
        Recipe().replace_from_text([assignment])
    assert message in str(caught.value)


def test_frozen_settings_refuse_every_change_and_stay_frozen_in_copies() -> None:
    original = Recipe()
    frozen = original.frozen()
    original.steps = 5
    assert frozen.steps == 10
    for settings in (frozen, copy.deepcopy(frozen), pickle.loads(pickle.dumps(frozen))):  # noqa: S301
        with pytest.raises(
            SettingsError, match="Setting 'steps' belongs to a started job and cannot change. Make a"
        ):
            settings.steps = 3
        with pytest.raises(SettingsError, match="belongs to a started job"):
            settings.mapper.matcher.ratio = 0.1
        with pytest.raises(SettingsError, match="belongs to a started job"):
            settings.param.update(steps=3)
    changed = frozen.replace({"mapper.matcher.ratio": 0.1})
    changed.steps = 4
    assert (frozen.mapper.matcher.ratio, changed.mapper.matcher.ratio, changed.steps) == (0.7, 0.1, 4)


def test_differences_name_settings_that_only_one_side_has() -> None:
    assert Matcher().differences(Mapper())["ratio"] == (0.8, None)
    assert Matcher().differences(Mapper())["offset"] == (None, 0.0)


def test_table_has_a_row_for_each_setting() -> None:
    rows = {row.name: row for row in Recipe.table()}
    assert list(rows) == [name for name, _ in Recipe().items()]
    features = rows["mapper.matcher.max_features"]
    assert (features.default, features.allowed, features.unit) == (2048, "whole number 16 to 65536", "features")
    assert rows["mapper.matcher.ratio"].doc == "Lowe's ratio, at most."
    assert rows["mapper.offset"].default == 2.0
    assert rows["mapper.growth"].allowed == "number above 1.0"


def test_flags_show_range_default_and_unit_in_the_help() -> None:
    parser = argparse.ArgumentParser()
    Recipe.add_flags(parser)
    text = " ".join(parser.format_help().split())
    assert (
        "--mapper.matcher.max-features INTEGER Most features kept per image. "
        "[2048 features; whole number 16 to 65536]" in text
    )
    assert "Shift, 50 % of it at least. [2.0 m; number" in text


def test_flags_that_were_not_given_keep_the_defaults_and_other_arguments_are_left_alone() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--steps-elsewhere", default="7")
    Recipe.add_flags(parser)
    settings = Recipe.from_flags(parser.parse_args(["--steps", "3"]))
    assert Recipe().differences(settings) == {"steps": (10, 3)}
