"""Hooks of mkdocs: a reference page for each group of public names, and formulas as MathML, without a script."""

import ast
import contextlib
import html
import pathlib
import posixpath
import re
import tempfile

import latex2mathml.converter
from mkdocs.structure.files import File

import optimize

ROOT = pathlib.Path(__file__).parents[1]
OPTIMIZE = "Design: the package `optimize`"
INCLUDED = {
    "contributing.md": "CONTRIBUTING.md",
    "engine.md": "jaxvib/ode/README.md",
    "cache.md": "jaxvib/runtime/README.md",
    "changelog.md": "CHANGELOG.md",
}
"""Pages whose text is in another folder of the project, by the name of the page."""


def public_groups():
    """{title: {public name: dotted path of its home}}: the groups of `jaxvib/__init__.pyi`, and `optimize`."""
    groups, title = {}, ""
    for line in (ROOT / "jaxvib" / "__init__.pyi").read_text(encoding="utf-8").splitlines():
        if line.startswith("# "):
            title = line[2:]
        elif line.startswith("from "):
            (node,) = ast.parse(line).body
            groups.setdefault(title, {}).update({alias.name: f"{node.module}.{alias.name}" for alias in node.names})
    groups[OPTIMIZE] = {name: f"{getattr(optimize, name).__module__}.{name}" for name in optimize.__all__}
    return groups


def address(title):
    """The file of a group's page."""
    return "reference/" + re.sub(r"\W+", "_", title.lower()).strip("_") + ".md"


def on_config(config):
    """Add the pages of the reference to the navigation."""
    for entry in config.nav:
        if isinstance(entry, dict) and "Reference" in entry:
            entry["Reference"] = [{title.replace("`", ""): address(title)} for title in public_groups()]
    return config


def on_files(files, config):
    """Add the generated pages of the reference, the figures, and the pages of `INCLUDED`."""
    for page, source in INCLUDED.items():
        files.append(File.generated(config, page, content=(ROOT / source).read_text(encoding="utf-8")))
    for name, content in _figures().items():
        files.append(File.generated(config, f"made/{name}", content=content))
    for title, names in public_groups().items():
        package = "optimize" if title == OPTIMIZE else "jaxvib"
        parts = [f"# {title}\n"]
        for name, home in sorted(names.items(), key=lambda item: item[0].lower()) if package == "optimize" else names.items():
            parts.append(f"::: {home}\n    options:\n      heading: {package}.{name}\n      toc_label: {name}\n")
        files.append(File.generated(config, address(title), content="\n".join(parts)))
    return files


def on_page_markdown(markdown, page, **_):
    """Replace links between files of the project by links between pages."""
    folder = posixpath.dirname(INCLUDED.get(page.file.src_uri, f"docs/{page.file.src_uri}"))
    pages = {source: name for name, source in INCLUDED.items()}

    def link(found):
        path = posixpath.normpath(posixpath.join(folder, found[1]))
        return f"]({pages.get(path, path.removeprefix('docs/'))}" if path in pages or path.startswith("docs/") else found[0]

    return re.sub(r"\]\(([\w./-]+)", link, markdown)


def _figures():
    """{name: bytes} of what the examples on the page of figures draw."""
    blocks = re.findall(r"```python\n(.*?)```", (ROOT / "docs" / "figures.md").read_text(encoding="utf-8"), flags=re.S)
    with tempfile.TemporaryDirectory() as folder, contextlib.chdir(folder):
        for block in blocks:
            exec(compile(block, "figures.md", "exec"), {})
        return {path.name: path.read_bytes() for path in sorted(pathlib.Path(folder).iterdir())}


_MATH = re.compile(r'<(span|div) class="arithmatex">\\[(\[](.*?)\\[)\]]</\1>([.,;:)]*)', flags=re.S)


def on_page_content(content, **_):
    r"""\( ... \) and \[ ... \] as MathML, which browsers draw by themselves."""

    def drawn(found):
        display = "block" if found[1] == "div" else "inline"
        formula = latex2mathml.converter.convert(html.unescape(found[2]), display=display)
        return f'<span class="formula">{formula}{found[3]}</span>'  # with the comma behind it, on one line

    return _MATH.sub(drawn, content)
