"""Hook of mkdocs: pages that are made of the code, the navigation, and formulas without scripts."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

from docs_api import api_pages
from docs_math import with_formulas
from docs_methods import method_families, method_page, methods_index
from docs_notebooks import NotebookPage, notebook_page, with_outputs
from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files
from mkdocs.structure.pages import Page
from run_notebooks import notebooks

from toolkit.recipes.registry import find_recipe

_METHODS, _NOTEBOOKS = "methods/", "notebooks/"
_PLOTLY = "assets/plotly.min.js"
_FENCE = re.compile(r"^(```|~~~)")
_HEADING = re.compile(r"^#{1,5} ")


def on_config(config: MkDocsConfig) -> MkDocsConfig:
    """Put into the navigation what is listed elsewhere: methods, rooms, results."""
    docs = Path(config.docs_dir)
    sections: dict[str, list[Any]] = {
        "Methods": [
            "methods/index.md",
            *(
                {title: [f"{_METHODS}{each.name}.md" for each in found]}
                for title, found in method_families().items()
            ),
        ],
        "Notebooks": [f"{_NOTEBOOKS}{path.stem}.md" for path in notebooks()],
        "API": [{_room(name): f"api/{name}.md"} for name in api_pages()],
        "Teaching": [
            *(name for name in ("workshop.md", "instructor.md") if (docs / name).is_file()),
            *(path.relative_to(docs).as_posix() for path in sorted((docs / "handouts").glob("*.md"))),
        ],
        "Tables": [path.relative_to(docs).as_posix() for path in sorted((docs / "results").rglob("*.md"))],
    }
    config.nav = _filled(config.nav, sections, docs)
    return config


def _room(name: str) -> str:
    return "toolkit" if name == "ground" else f"toolkit.{name}"


def _filled(nav: Any, sections: dict[str, list[Any]], docs: Path) -> Any:
    """Return the navigation with its empty sections filled."""
    made = []
    for entry in nav:
        if isinstance(entry, dict):
            ((title, below),) = entry.items()
            if isinstance(below, list):
                below = _filled(below, sections, docs) if below else sections[title]
            made.append({title: below})
        else:
            made.append(entry)
    return made


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add the pages that no file in docs/ is."""
    pages = {f"api/{name}.md": text for name, text in api_pages().items()}
    pages[f"{_METHODS}index.md"] = methods_index()
    for path in notebooks():
        made = _notebook_pages[f"{_NOTEBOOKS}{path.stem}.md"] = notebook_page(path)
        pages[f"{_NOTEBOOKS}{path.stem}.md"] = made.text
        for name, content in made.pictures.items():
            files.append(File.generated(config, f"{_NOTEBOOKS}{name}", content=content))
        files.append(File.generated(config, f"{_NOTEBOOKS}{path.name}", abs_src_path=str(path)))
    files.append(File.generated(config, _PLOTLY, abs_src_path=str(_plotly_script())))
    for name, text in pages.items():
        files.append(File.generated(config, name, content=text))
    return files


#: By the names of their files: what belongs to pages of notebooks.
_notebook_pages: dict[str, NotebookPage] = {}


def _plotly_script() -> Path:
    import plotly

    return Path(plotly.__file__).parent / "package_data" / "plotly.min.js"


def on_page_markdown(markdown: str, page: Page, config: MkDocsConfig, files: Files) -> str:
    """Give pages of methods their head and settings, and every page one title."""
    name = page.file.src_uri
    if name.startswith(_METHODS) and name != f"{_METHODS}index.md":
        return method_page(find_recipe(Path(name).stem), markdown)
    return one_title(markdown)


def on_page_content(html: str, page: Page, config: MkDocsConfig, files: Files) -> str:
    """Draw formulas, and put the outputs of notebooks where they belong."""
    made = _notebook_pages.get(page.file.src_uri)
    return with_formulas(html) if made is None else with_outputs(with_formulas(html), made.outputs)


def on_post_page(output: str, page: Page, config: MkDocsConfig) -> str:
    """Load Plotly on the pages that have figures."""
    made = _notebook_pages.get(page.file.src_uri)
    if made is None or not made.has_figures:
        return output
    loaded = "".join(f'<script src="../{name}"></script>' for name in (_PLOTLY, "assets/figures.js"))
    return output.replace("</body>", f"{loaded}</body>")


def one_title(markdown: str) -> str:
    """Return a page whose first heading alone is of the first level; of more, all others go down by one."""
    lines, inside, heads = markdown.split("\n"), False, []
    for i, line in enumerate(lines):
        if _FENCE.match(line.lstrip()):
            inside = not inside
        elif not inside and _HEADING.match(line):
            heads.append(i)
    if sum(lines[i].startswith("# ") for i in heads) > 1:
        for i in heads[1:]:
            lines[i] = "#" + lines[i]
    return "\n".join(lines)
