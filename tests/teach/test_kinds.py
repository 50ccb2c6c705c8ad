"""What readers type: read in its plain form, or answered with a hint that says what is asked for."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from toolkit.teach.kinds import Kind, Unreadable, choice, near, number, numbers, ranking, several


@pytest.mark.parametrize(
    "answer", [3, 3.0, np.int64(3), np.float32(3), np.array(3.0), np.array([[3]]), torch.tensor(3.0)]
)
def test_a_number_is_read_whatever_holds_it(answer: object) -> None:
    read = number().read(answer)
    assert isinstance(read, float)
    assert read == 3.0


@pytest.mark.parametrize(
    ("answer", "said"),
    [
        ("3", "This is a text. Write a number (dB), as in `answer = 12.5`. Leave the quotation marks out."),
        (True, "a truth value"),
        (np.bool_(True), "a truth value"),
        ([3], "a list"),
        ({3}, "a set"),
        ({"three": 3}, "a dictionary"),
        (3j, "a number"),
        (np.zeros(2), "more than one number"),
        (torch.zeros(2), "more than one number"),
        (np.array(["3"]), "a text"),
        (float("nan"), "This number is nan"),
        (np.float32("inf"), "This number is inf"),
        (10**400, "This number is inf"),
        (object(), "something of the type `object`"),
        (np.float64, "something of the type `type`"),
        (len, "something of the type `builtin_function_or_method`"),
    ],
)
def test_what_is_no_number_is_called_by_its_name(answer: object, said: str) -> None:
    with pytest.raises(Unreadable) as raised:
        number("dB").read(answer)
    assert said in str(raised.value)


def test_numbers_are_asked_for_by_name() -> None:
    kind = numbers("before", "after")
    assert kind.how == 'Write numbers by name: `answer = {"before": ..., "after": ...}`.'
    assert kind.read({"before": 1, "after": np.float64(2)}) == {"before": 1.0, "after": 2.0}


@pytest.mark.parametrize(
    ("answer", "said"),
    [
        ([1, 2], "This is a list."),
        ({"before": 1}, 'There is no number yet for "after".'),
        ({"before": 1, "after": ...}, 'There is no number yet for "after".'),
        ({"before": None, "after": None}, 'There is no number yet for "before", "after".'),
        ({"before": 1, "after": np.zeros(2)}, "more than one number"),
        ({"before": 1, "after": "2"}, "This is a text."),
    ],
)
def test_numbers_that_are_not_all_there_are_named(answer: object, said: str) -> None:
    with pytest.raises(Unreadable) as raised:
        numbers("before", "after").read(answer)
    assert said in str(raised.value)


def test_a_choice_does_not_mind_capitals_and_blanks() -> None:
    assert choice("GPS", "gimbal").read(" gps ") == "GPS"


@pytest.mark.parametrize(
    ("kind", "answer", "said"),
    [
        (choice("a", "b"), 1, "This is a number, and a word is asked for."),
        (choice("a", "b"), "c", '"c" is none of them. Write one of "a", "b", with the quotation marks.'),
        (choice("a", "b"), ["a"], "This is a list, and a word is asked for."),
        (several("a", "b"), 1, "This is a number, and a list is asked for."),
        (several("a", "b"), ["a", 1], "This is a number, and a word is asked for."),
        (ranking("a", "b"), {"a", "b"}, "A set has no order."),
        (ranking("a", "b"), ["b"], 'Still to be placed: "a".'),
        (ranking("a", "b"), ["b", "a", "b"], "One of them is there twice."),
        (ranking("a", "b"), {"a": 1, "b": 2}, "A dictionary has no order."),
        (ranking("a", "b"), 7, "This is a number, and a list is asked for."),
    ],
)
def test_words_that_do_not_fit_are_answered_with_what_does(kind: Kind, answer: object, said: str) -> None:
    with pytest.raises(Unreadable) as raised:
        kind.read(answer)
    assert said in str(raised.value)


def test_the_order_counts_in_a_ranking_only() -> None:
    assert several("a", "b", "c").read(["c", "A"]) == several("a", "b", "c").read(("a", "c"))
    assert several("a", "b").read([]) == frozenset()
    assert several("a", "b").read("b") == frozenset({"b"})
    assert ranking("a", "b").read(["B", "a"]) == ("b", "a")


def test_near_takes_the_wider_of_a_share_and_a_length() -> None:
    assert near(101, 100, relative=0.011)
    assert not near(102, 100, relative=0.011)
    assert near(0.3, 0.0, absolute=0.3)
    assert not near(0.3, 0.0)
