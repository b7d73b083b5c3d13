# SPDX-License-Identifier: Apache-2.0
"""What MkDocs calls: pages made from the code, boards, documents from outside docs/, links between them, notebooks."""

import os
import re
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import Any, Final

import boards
import notebook
import reference
from mkdocs.config.defaults import MkDocsConfig
from mkdocs.exceptions import PluginError
from mkdocs.structure.files import File, Files
from mkdocs.structure.pages import Page

ROOT: Final = Path(__file__).parents[2]
# Documents that lie beside the data that they describe, and their pages.
OUTSIDE: Final = {
    "CHANGELOG.md": "repository/changelog.md",
    "CONTRIBUTING.md": "repository/contributing.md",
    "DATA-LICENSE.md": "repository/data-licence.md",
    **{f"{name}/README.md": f"repository/{name}.md" for name in ("benchmarks", "pipelines", "regions", "splits")},
    "submissions/README.md": "repository/submissions.md",
}
_LINK: Final = re.compile(r"\[((?:[^\[\]]|\[[^\]]*\])*)\]\(([^)#\s]+)(#[^)\s]*)?\)")
_FOREIGN: Final = re.compile(
    r"<(?:script|img|iframe|link(?![^>]*rel=.?canonical))\b[^>]*(?:src|href)=.?(https?://[^\"'\s>]+)"
)
_TABLES: Final = re.compile(r"^results/([\w-]+)/leaderboard\.md$")
_FENCE: Final = re.compile(r"^(```.*?^```$)", re.MULTILINE | re.DOTALL)


def on_config(config: MkDocsConfig) -> MkDocsConfig:
    """Put the pages of each folder of the navigation in its place."""
    pages = sorted({*_made(), *_written()}, key=lambda page: (not page.endswith("index.md"), page))
    config.nav = list(_spread(config.nav, pages))
    return config


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add the pages that are made from code, sites of boards, notebooks, and the documents from outside docs/."""
    for path, text in _made().items():
        files.append(File.generated(config, path, content=text))
    for path, data in boards.sites():
        files.append(File.generated(config, path, content=data))
    for path, page in OUTSIDE.items():
        files.append(File.generated(config, page, content=(ROOT / path).read_text(encoding="utf-8")))
    for path, content in notebook.pages(ROOT / "docs" / "notebooks", ROOT / "out").items():
        files.append(File.generated(config, path, content=content))
    return files


def on_page_markdown(markdown: str, page: Page, config: MkDocsConfig, files: Files) -> str:
    """Lead links to pages and pictures of the site; what is in the repository alone becomes text with its path.

    Links to the tables of a stored board lead to its site. Pages outside the menu are left out of the search.
    """
    sources = {page: path for path, page in OUTSIDE.items()}
    own = page.file.src_uri
    if config.not_in_nav is not None and config.not_in_nav.match_file(own):
        page.meta["search"] = {"exclude": True}
    folder = Path(sources.get(own, f"docs/{own}")).parent

    def lead(link: re.Match[str]) -> str:
        """Return one link as the site has it."""
        text, target, anchor = link[1], link[2], link[3] or ""
        path = os.path.normpath(folder / target)
        if "://" in target or target.startswith("mailto:"):
            return link[0]
        uri = OUTSIDE.get(path, path.removeprefix("docs/"))
        if (ROOT / path).is_dir():
            uri += "/index.md"
        elif uri.startswith("notebooks/"):
            uri = uri.removesuffix(".py") + ".md"
        uri = _TABLES.sub(lambda board: f"{boards.site_of(board[1])}/index.html", uri)
        found = files.get_file_from_path(uri)
        if found is not None and not found.inclusion.is_excluded():
            return f"[{text}]({os.path.relpath(uri, Path(own).parent)}{anchor})"
        if (ROOT / path).exists():
            return text if path in text else f"{text} (`{path}`)"
        return link[0]  # MkDocs says that it leads nowhere

    parts = _FENCE.split(markdown)
    return "".join(part if part.startswith("```") else _LINK.sub(lead, part) for part in parts)


def on_post_build(config: MkDocsConfig) -> None:
    """Refuse a site that asks another host for a script, a style, a font or a picture."""
    for path in sorted(Path(config.site_dir).rglob("*.html")):
        found = _FOREIGN.search(path.read_text(encoding="utf-8"))
        if found:
            raise PluginError(f"{path.relative_to(config.site_dir)} asks another host for {found[1]}")


@cache
def _made() -> dict[str, str]:
    """Pages that are made from code and stored results, by path."""
    return {**reference.pages(), boards.PAGE: boards.page(reference.table), "decisions/index.md": _decisions()}


def _written() -> Iterator[str]:
    """Pages of docs/ as they are written."""
    for path in (ROOT / "docs").rglob("*.md"):
        yield path.relative_to(ROOT / "docs").as_posix()


def _decisions() -> str:
    """A page that lists the decision records by their headings."""
    records = sorted((ROOT / "docs" / "decisions").glob("*.md"))
    titles = [path.read_text(encoding="utf-8").splitlines()[0].removeprefix("# ") for path in records]
    lines = [f"- [{title}]({path.name})" for title, path in zip(titles, records, strict=True)]
    return "\n".join(("# Decisions", "", "One page each: context, choice, price.", "", *lines))


def _spread(items: list[Any], pages: list[str]) -> Iterator[Any]:
    """Navigation with each folder, `name/` or `name/*/`, replaced by the pages in it."""
    for item in items:
        title, value = next(iter(item.items())) if isinstance(item, dict) else (None, item)
        if isinstance(value, list):
            yield {title: list(_spread(value, pages))}
        elif value.endswith("/"):
            inside = [page for page in pages if _is_in(page, value)]
            yield from [{title: inside}] if title else inside
        else:
            yield item


def _is_in(page: str, folder: str) -> bool:
    return re.fullmatch(re.escape(folder).replace(r"\*", "[^/]+") + "[^/]+", page) is not None
