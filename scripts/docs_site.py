"""Hooks of mkdocs: the README is the first page, links that leave docs/ become plain names, code is coloured twice.

Pages of the reference that git does not hold are read from ``extra: reference`` of mkdocs.yml, where ``make docs``
writes them. What lies outside docs/ (sources, examples) is not part of the site: such a link becomes the name of the
file. The search works from disk (docs_search.js).
"""

from __future__ import annotations

import re
from pathlib import Path

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.exceptions import PluginError
from mkdocs.structure.files import File, Files
from mkdocs.structure.pages import Page
from pygments.formatters.html import HtmlFormatter

ROOT = Path(__file__).resolve().parent.parent
# Where a page goes that mkdocs.yml does not name, by its folder.
SECTIONS = {"howto": "How to", "reference": "Reference", "": "Explanations"}
LINK = re.compile(r"(?<!!)\[([^]]+)\]\((?!\w+:|#)([^)#\s]+)(#[^)\s]*)?\)")
BY_HASH, ESCAPED = "findOne(decodeURI(e.hash)", 'findOne("#"+CSS.escape(decodeURI(e.hash).slice(1))'
LIGHT, DARK = "default", "github-dark"
# the theme's light blue is too pale to be read on white
LINKS = """[data-bs-theme=light] { --bs-link-color-rgb: 11, 92, 148; --bs-link-hover-color-rgb: 7, 62, 100; }
[data-bs-theme=light] .bs-sidebar .nav-link { color: rgb(11, 92, 148); }
"""
# so is white on the bar at the top; and what the highlighter takes for output of a console are commands
READABLE = """.navbar.bg-primary { background: rgb(11, 92, 148) !important; }
.navbar .nav-link:not(.disabled) { color: #fff; }
[data-bs-theme] .codehilite .go { color: inherit; }
[role=main] pre, [role=main] pre code { font-size: .875rem; }
"""
# what is wider than a phone scrolls by itself
WIDE = """[role=main] table { display: block; overflow-x: auto; max-width: 100%; width: max-content; }
[role=main] img { max-width: 100%; height: auto; }
[role=main] { overflow-wrap: break-word; }
@media (max-width: 600px) {
  [role=main] td:first-child { min-width: 9rem; }
  /* of the moving picture both halves are to be seen at once */
  [role=main] p:has(> img) { overflow-x: auto; }
  [role=main] p > img:not([src*=before_after]) { max-width: none; width: 620px; }
}
"""


def on_config(config: MkDocsConfig) -> MkDocsConfig:
    """The configuration, every page of docs/ being somewhere in its navigation."""
    named = set(re.findall(r"[\w/]+\.md", repr(config.nav)))
    folder = Path(config.docs_dir)
    for file in sorted(folder.rglob("*.md")):
        page = file.relative_to(folder)
        if page.as_posix() not in named:
            title = SECTIONS.get(page.parts[0] if len(page.parts) > 1 else "", SECTIONS[""])
            (section,) = [part[title] for part in config.nav or [] if title in part]
            section.append(page.as_posix())
    return config


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """The files, with the README as index.md, the built reference, and colours for code."""
    readme = (ROOT / "README.md").read_text(encoding="utf-8")
    files.append(File.generated(config, "index.md", content=re.sub(r"(\]\(|src=\")docs/", r"\1", readme)))
    rules = [
        rule
        for scheme, style in (("light", LIGHT), ("dark", DARK))
        for rule in HtmlFormatter(style=style).get_style_defs(f"[data-bs-theme={scheme}] .codehilite").splitlines()
        if rule.startswith("[data-bs-theme") and ".linenos" not in rule
    ]
    built = ROOT / config.extra["reference"]
    if not built.is_dir():
        raise PluginError(f"{built}: no such folder: run make docs, which writes the reference there")
    for page in sorted(built.rglob("*.md")):
        name = f"reference/{page.relative_to(built).as_posix()}"
        files.append(File.generated(config, name, content=page.read_text(encoding="utf-8")))
    files.append(File.generated(config, "site.css", content=LINKS + WIDE + "\n".join(rules) + "\n" + READABLE))
    return files


def on_post_build(config: MkDocsConfig) -> None:
    """Replace the search that needs a server by one that needs none: the index as a script, and who reads it."""
    folder = Path(config.site_dir) / "search"
    index = (folder / "search_index.json").read_text(encoding="utf-8")
    (folder / "search_index.js").write_text(f"window.modcal_search_index = {index};\n", encoding="utf-8")
    (folder / "main.js").write_text((ROOT / "scripts" / "docs_search.js").read_text(encoding="utf-8"), encoding="utf-8")
    for unused in ("search_index.json", "worker.js"):
        (folder / unused).unlink()
    # the theme's switch of colours expects the highlighter that is left out, and ends without it
    switch = Path(config.site_dir) / "js" / "darkmode.js"
    text = re.sub(r"(hljs_(?:light|dark))(\.disabled)", r"if (\1) \1\2", switch.read_text(encoding="utf-8"))
    switch.write_text(text, encoding="utf-8")
    # and its list of contents takes an id for a selector, which may not begin with a digit
    contents = Path(config.site_dir) / "js" / "bootstrap.bundle.min.js"
    text = contents.read_text(encoding="utf-8")
    assert text.count(BY_HASH) == 1, "the theme's script is another one: see whether it still needs this"
    contents.write_text(text.replace(BY_HASH, ESCAPED), encoding="utf-8")


def on_page_markdown(markdown: str, page: Page, config: MkDocsConfig, files: Files) -> str:
    """The page's text without links to what the site does not hold."""
    home = page.file.src_uri == "index.md"
    here = ROOT if home else (Path(config.docs_dir) / page.file.src_uri).parent

    def plain(link: re.Match[str]) -> str:
        target = (here / link[2]).resolve()
        outside = target.is_relative_to(ROOT) and not target.is_relative_to(config.docs_dir)
        if not outside or not target.exists() or (home and files.get_file_from_path(link[2]) is not None):
            return link[0]
        name = f"`{target.relative_to(ROOT)}`"
        if "`" in link[1]:
            return link[1]
        return name if link[1] == name.strip("`") else f"{link[1]} ({name})"

    return LINK.sub(plain, markdown)
