"""Pages of methods are whole, links lead somewhere, and what is committed is what the commands make."""

from __future__ import annotations

import importlib
import re
from pathlib import Path

import pytest
from doc_blocks import ROOT, page_id, pages, prose

from toolkit.recipes.registry import built_in_recipes

METHODS = ROOT / "docs" / "methods"
PARTS = ["When to use it", "Stages", "Limits", "Source"]
LINK = re.compile(r"!?\[[^\]]*\]\(([^()\s]+(?:\([^()]*\))?)\)")
#: Pages that the site makes of the code have no file.
MADE = re.compile(r"docs/(api/[a-z]+|methods/index|notebooks/\d\d_[a-z_]+)\.md$")


@pytest.mark.parametrize("name", built_in_recipes())
def test_every_recipe_has_a_page_with_its_limits(name: str) -> None:
    page = METHODS / f"{name}.md"
    assert page.is_file(), f"write {page}: what it does, when to use it, stages, limits, source"
    text = page.read_text(encoding="utf-8")
    assert re.findall(r"^## (.*)$", text, re.MULTILINE) == PARTS
    limits = text.split("## Limits\n")[1].split("\n## ")[0]
    assert limits.count("\n- ") >= 1
    assert len(limits) > 80, "limits are told, not mentioned"
    assert text.startswith(f"# {built_in_recipes()[name].title}\n")


def test_no_page_is_of_a_recipe_that_is_gone() -> None:
    assert {page.stem for page in METHODS.glob("*.md")} == set(built_in_recipes())


@pytest.mark.parametrize("name", built_in_recipes())
def test_the_stages_of_a_page_are_names_in_the_code(name: str) -> None:
    text = (METHODS / f"{name}.md").read_text(encoding="utf-8").split("## Stages\n")[1].split("\n## ")[0]
    code = "".join(path.read_text(encoding="utf-8") for path in (ROOT / "toolkit").rglob("*.py"))
    named = re.findall(r"^(?:\d\. |)((?:`[a-z0-9 -]+`(?:, )?)+)", text, re.MULTILINE)
    for stage in re.findall(r"`([^`]+)`", " ".join(named)):
        assert f'"{stage}"' in code or stage in built_in_recipes(), f"no stage is named '{stage}'"


def slug(heading: str) -> str:
    """Return the anchor that Python-Markdown gives a heading."""
    words = re.sub(r"\[([^\]]*)\]\([^)]*\)", r"\1", heading).replace("`", "")
    kept = re.sub(r"[^\w\s-]", "", words.encode("ascii", "ignore").decode()).strip().lower()
    return re.sub(r"[-\s]+", "-", kept)


def anchors(page: Path) -> set[str]:
    """Return the anchors of a page."""
    found: set[str] = set()
    for heading in re.findall(r"^#{1,6} (.*)$", prose_with_code(page), re.MULTILINE):
        name, count = slug(heading), 1
        while name in found:
            name, count = f"{slug(heading)}_{count}", count + 1
        found.add(name)
    return found


def prose_with_code(page: Path) -> str:
    """Return a page without its fenced blocks."""
    return re.sub(r"^(```|~~~).*?^\1$", "", page.read_text(encoding="utf-8"), flags=re.MULTILINE | re.DOTALL)


@pytest.mark.parametrize("page", pages(), ids=page_id)
def test_links_lead_somewhere(page: Path) -> None:
    for target in LINK.findall(prose(page)):
        if re.match(r"[a-z]+:", target):
            assert target.startswith("https://"), target
            continue
        path, _, anchor = target.partition("#")
        aim = (page.parent / path).resolve() if path else page
        if MADE.search(aim.as_posix()):
            continue
        assert aim.exists(), f"{page_id(page)}: {target} leads nowhere"
        if anchor:
            assert anchor in anchors(aim), f"{page_id(page)}: {target}: the page has no heading of that name"


def test_a_link_that_leads_nowhere_would_be_found(tmp_path: Path) -> None:
    page = tmp_path / "page.md"
    page.write_text("# One `two` (three)\n\n[x](other.md) `[y](code.md)`\n\n```text\n# no\n[z](z.md)\n```\n")
    assert LINK.findall(prose(page)) == ["other.md"]
    assert anchors(page) == {"one-two-three"}


@pytest.mark.slow
def test_the_figures_of_the_concepts_are_those_that_the_command_draws(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.syspath_prepend(str(ROOT / "scripts"))
    importlib.import_module("docs_figures").main(tmp_path)
    committed = ROOT / "docs" / "images" / "concepts"
    made = {path.name: path for path in tmp_path.glob("*.svg")}
    assert set(made) == {path.name for path in committed.glob("*.svg")}
    for name, path in made.items():
        # Numbers may differ in their last digit from machine to machine.
        assert len(path.read_text()) == pytest.approx(len((committed / name).read_text()), rel=0.02), name
