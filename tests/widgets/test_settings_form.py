"""The form that is made from declared settings."""

from __future__ import annotations

from typing import Any

import panel as pn
import pytest

from toolkit.recipes.registry import all_recipes
from toolkit.settings import Boolean, Choice, Group, Integer, Number, Settings, Text
from toolkit.widgets.settings_form import SettingsForm


class Inner(Settings):
    """Of a stage."""

    steps = Integer(100, bounds=(1, 1000), unit="steps", doc="How many steps.")
    rate = Number(0.5, bounds=(0.0, 1.0), doc="How fast.")


class Outer(Settings):
    """Of a recipe."""

    mode = Choice("plain", choices=("plain", "odd"), doc="Which way.")
    fast = Boolean(False, doc="Whether to hurry.")
    note = Text("", doc="A line of text.")
    train = Group(Inner(steps=200), doc="Training")


def parts(form: SettingsForm, kind: type) -> list[Any]:
    layout = form.__panel__()
    assert isinstance(layout, pn.Column)
    return list(layout.select(kind))


def widget(form: SettingsForm, label: str) -> pn.widgets.Widget:
    (found,) = [each for each in parts(form, pn.widgets.Widget) if each.label == label]
    return found


def cards(form: SettingsForm) -> dict[str, bool]:
    return {card.title: card.visible for card in parts(form, pn.Card)}


def test_every_setting_of_every_method_has_a_widget_and_starts_unchanged() -> None:
    for recipe in all_recipes().values():
        form = SettingsForm(recipe.settings_type)
        assert form.changed == []
        assert form.error == ""
        assert form.settings().to_dict() == recipe.settings_type().to_dict()


def test_defaults_are_those_of_the_recipe_and_changes_are_marked() -> None:
    form = SettingsForm(Outer)
    steps = widget(form, "steps")
    assert steps.value == 200  # the recipe's, not the stage's
    assert (steps.start, steps.end) == (None, None)  # what is beyond the bounds reaches the form, which says so
    assert steps.description == "How many steps. Whole number 1 to 1000; default 200 steps."
    steps.value = 50
    widget(form, "fast").value = True
    assert form.changed == ["fast", "train.steps"]
    assert steps.css_classes == ["changed"]
    assert list(cards(form)) == ["General · 1 changed", "Training · 1 changed"]
    settings = form.settings()
    assert isinstance(settings, Outer)
    assert (settings.fast, settings.train.steps, settings.mode) == (True, 50, "plain")
    steps.value = 200
    assert form.changed == ["fast"]
    assert steps.css_classes == []


def test_settings_of_an_earlier_run_are_filled_in_and_taken_back() -> None:
    form = SettingsForm(Outer)
    form.fill(Outer(mode="odd", note="again").replace({"train.rate": 0.25}))
    assert form.changed == ["mode", "note", "train.rate"]
    (reset,) = [each for each in parts(form, pn.widgets.Button) if each.label == "Back to defaults"]
    assert not reset.disabled
    reset.clicks += 1
    assert form.changed == []
    assert reset.disabled


@pytest.mark.parametrize("value", [5.0, float("nan"), None])
def test_a_value_that_cannot_be_is_told_with_what_is_expected(value: float | None) -> None:
    form = SettingsForm(Outer)
    rate = widget(form, "rate")
    rate.value = value
    assert "Setting 'rate' is out of range or of the wrong type; expected number 0.0 to 1.0" in form.error
    rate.value = 0.5
    assert form.error == ""


def test_settings_are_found_by_name_and_by_what_they_do() -> None:
    form = SettingsForm(Outer)
    (search,) = [each for each in parts(form, pn.widgets.TextInput) if each.placeholder.startswith("Find")]
    search.value_input = "HURRY"
    assert cards(form) == {"General": True, "Training": False}
    assert widget(form, "fast").visible
    assert not widget(form, "mode").visible
    search.value_input = ""
    assert cards(form) == {"General": True, "Training": True}
    widget(form, "rate").value = 0.1
    widget(form, "Only those that were changed").value = True
    assert cards(form) == {"General": False, "Training · 1 changed": True}
