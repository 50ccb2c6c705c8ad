"""Checks: an answer of any kind gets a verdict, a mistake in the cell is an error that names it."""

from __future__ import annotations

from dataclasses import FrozenInstanceError

import pytest

from toolkit.errors import SettingsError
from toolkit.teach import Verdict, check, checking
from toolkit.teach.registry import exercises_of, find_exercise, lessons


@pytest.fixture(autouse=True)
def _no_tries(monkeypatch: pytest.MonkeyPatch) -> None:
    """Tries of one test do not count in the next."""
    monkeypatch.setattr(checking, "_wrong", {})


@pytest.mark.parametrize("answer", [None, ...])
def test_no_answer_is_answered_with_the_question_and_how_to_answer(answer: object) -> None:
    verdict = check("tour.pairs", answer, photos=24)
    assert verdict.state == "open"
    assert verdict.text.startswith("How many pairs")
    assert "`answer = 12.5`" in verdict.text


@pytest.mark.parametrize("empty", [None, ...])
def test_a_dictionary_is_open_until_something_is_filled_in(empty: object) -> None:
    assert check("blades.drift", {"independent": empty, "alike": empty}, frames=121).state == "open"
    verdict = check("blades.drift", {"independent": 0.55, "alike": empty}, frames=121)
    assert verdict.state == "wrong"
    assert 'There is no number yet for "alike".' in verdict.text


def test_a_right_answer_comes_with_the_reason() -> None:
    verdict = check("tour.pairs", 276, photos=24)
    assert verdict.state == "right"
    assert "24·23/2" in verdict.text


@pytest.mark.parametrize(
    ("answer", "said"),
    [(552, "counts each pair twice"), (576, "with itself"), ("276", "Leave the quotation marks out")],
)
def test_each_usual_mistake_has_its_own_hint(answer: object, said: str) -> None:
    verdict = check("tour.pairs", answer, photos=24)
    assert verdict.state == "wrong"
    assert said in verdict.text
    assert "276 pairs" not in verdict.text


def test_a_further_wrong_answer_gets_a_stronger_hint_and_the_same_one_does_not() -> None:
    first = check("tour.pairs", 24, photos=24).text
    assert check("tour.pairs", 24, photos=24).text == first
    second = check("tour.pairs", 25, photos=24).text
    assert second != first
    assert check("tour.pairs", 26, photos=24).text == second


def test_an_unreadable_answer_is_no_try() -> None:
    check("tour.pairs", "many", photos=24)
    fresh = check("tour.pairs", 24, photos=24).text
    assert fresh.startswith("How many partners")


def test_an_unknown_exercise_is_an_error_with_the_nearest_names() -> None:
    with pytest.raises(SettingsError, match=r"no exercise 'tour\.pair'; expected one like .*tour\.pairs"):
        check("tour.pair", 276, photos=24)
    with pytest.raises(SettingsError, match=r"no exercise 'pairs'"):
        check("pairs", 276)
    with pytest.raises(SettingsError, match=r"no exercise '\?\?\?'; expected one of .*tour\.pairs"):
        check("???", 276)
    with pytest.raises(SettingsError, match="by its name; expected a text; found int"):
        check(276)


@pytest.mark.parametrize(("answer", "facts"), [(276, {}), (None, {}), (276, {"photos": 24, "pictures": 24})])
def test_facts_that_do_not_fit_are_an_error_even_before_the_answer(
    answer: object, facts: dict[str, object]
) -> None:
    with pytest.raises(SettingsError, match=r"facts of exercise 'tour\.pairs' do not fit; expected photos; found"):
        check("tour.pairs", answer, **facts)


def test_a_verdict_is_words_in_a_terminal_and_a_box_in_a_notebook() -> None:
    verdict = Verdict("tour.pairs", "wrong", "Is `a < b` a pair of <photos>?")
    assert repr(verdict) == "tour.pairs: wrong. Is `a < b` a pair of <photos>?"
    page = verdict._repr_html_()
    assert "<strong>Not yet</strong>" in page
    assert "<code>a &lt; b</code> a pair of &lt;photos&gt;?" in page
    assert (
        "<em>squared</em> and <code>2 * a * b</code>"
        in Verdict("x", "open", "*squared* and `2 * a * b`")._repr_html_()
    )
    assert "one ` and *this*" in Verdict("x", "open", "one ` and *this*")._repr_html_()
    # The text keeps the page's own colour: it is read on light and on dark ground.
    assert "color: inherit" in page
    with pytest.raises(FrozenInstanceError):
        verdict.state = "right"


ALL = [name for lesson in lessons() for name in exercises_of(lesson)]


@pytest.mark.parametrize("name", ALL)
def test_every_exercise_asks_in_one_line_and_bears_any_type_of_answer(name: str) -> None:
    found = find_exercise(name)
    assert found.question.endswith(("?", "."))
    assert "\n" not in found.question
    assert len(found.question) <= 220
    facts = dict.fromkeys(found.facts)
    assert check(name, None, **facts).state == "open"
    # Of another kind than any exercise asks for: the judge never sees it, so the facts need not be true.
    for answer in (object(), b"bytes", len, 2j):
        verdict = check(name, answer, **facts)
        assert verdict.state == "wrong"
        assert found.kind.how in verdict.text
