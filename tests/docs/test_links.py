"""Links between the pages of the project, on the disk and in the built documentation."""

import importlib.util
import pathlib
import re
import types

import pytest

ROOT = pathlib.Path(__file__).parents[2]
PAGES = sorted({*ROOT.glob("*.md"), *(ROOT / "docs").glob("*.md"), *(ROOT / "jaxvib").rglob("*.md")})
GENERATED = "made/"
"""Folder of the figures that the build of the documentation draws."""


def links_of(text):
    """Relative paths of the links and images of a page, without anchors."""
    targets = [target for target in re.findall(r"\]\(([^)#\s]+)", text) if not target.startswith(("http", "mailto:"))]
    return [target for target in targets if not target.startswith(GENERATED)]


def test_links_lead_to_files_on_the_disk():
    assert sum(len(links_of(page.read_text(encoding="utf-8"))) for page in PAGES) > 100
    broken = [
        (page.name, x) for page in PAGES for x in links_of(page.read_text(encoding="utf-8")) if not (page.parent / x).exists()
    ]
    assert broken == []


def test_links_lead_to_pages_of_the_documentation():
    pytest.importorskip("mkdocs")
    pytest.importorskip("latex2mathml")
    spec = importlib.util.spec_from_file_location("hooks", ROOT / "docs" / "hooks.py")
    hooks = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(hooks)
    sources = {page.name: page for page in (ROOT / "docs").glob("*.md")} | {k: ROOT / v for k, v in hooks.INCLUDED.items()}
    for name, source in sources.items():
        page = types.SimpleNamespace(file=types.SimpleNamespace(src_uri=name))
        text = hooks.on_page_markdown(source.read_text(encoding="utf-8"), page=page)
        assert [x for x in links_of(text) if x not in sources and not (ROOT / "docs" / x).is_file()] == []
        assert not re.search(r"\]\(\.\./", text)
    index = types.SimpleNamespace(file=types.SimpleNamespace(src_uri="index.md"))
    assert hooks.on_page_markdown("[a](../jaxvib/ode/README.md#b)", page=index) == "[a](engine.md#b)"
