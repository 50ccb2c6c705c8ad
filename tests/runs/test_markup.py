"""HTML is escaped unless it was made by the page itself."""

from __future__ import annotations

from html.parser import HTMLParser

from hypothesis import given
from hypothesis import strategies as st

from toolkit.runs.markup import Html, element, joined, table


def test_texts_and_attributes_are_escaped() -> None:
    made = element("p", "<script>", title='"><img src=x>')
    assert made == '<p title="&quot;&gt;&lt;img src=x&gt;">&lt;script&gt;</p>'


def test_elements_go_into_elements_as_they_are() -> None:
    assert element("p", "a ", element("b", "&"), None, ["x", Html("<i></i>")]) == "<p>a <b>&amp;</b>x<i></i></p>"


def test_attributes_are_named_as_in_python() -> None:
    made = element("img", class_="a", data_run=1, hidden=True, alt=None, open=False, http_equiv="x")
    assert made == '<img class="a" data-run="1" hidden http-equiv="x">'


def test_cells_of_a_table_are_wrapped_once() -> None:
    made = table(["", "a"], [["name", element("td", "1", class_="best")], ["<b>", "2"]])
    assert '<th scope="row">name</th><td class="best">1</td>' in made
    assert '<th scope="row">&lt;b&gt;</th><td>2</td>' in made


@given(st.text(), st.text())
def test_no_text_can_add_an_element_or_an_attribute(text: str, value: str) -> None:
    class Seen(HTMLParser):
        def __init__(self) -> None:
            super().__init__()
            self.tags: list[tuple[str, list[tuple[str, str | None]]]] = []
            self.text = ""

        def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
            self.tags.append((tag, attrs))

        def handle_data(self, data: str) -> None:
            self.text += data

    seen = Seen()
    seen.feed(element("p", text, title=value))
    seen.close()
    assert [tag for tag, _ in seen.tags] == ["p"]
    assert [name for name, _ in seen.tags[0][1]] == ["title"]


def test_plain_text_is_escaped_and_nothing_is_empty() -> None:
    assert joined("a & b") == "a &amp; b"
    assert joined(None) == ""
