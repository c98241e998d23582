"""The layout of the code: imports go down only, without circles; folders and files stay small."""

import ast
import collections
import functools
import pathlib

import pytest

ROOT = pathlib.Path(__file__).parents[1]

FLOORS = (
    ("jaxvib.cli",),
    ("jaxvib.sweeps", "jaxvib.report", "jaxvib.explore", "jaxvib.exchange"),
    ("jaxvib.identification",),
    ("jaxvib.study", "jaxvib.show", "optimize"),
    ("jaxvib.motion",),
    ("jaxvib.steady",),
    ("jaxvib.equations",),
    ("jaxvib.machine",),
    ("jaxvib.ode", "jaxvib.draw", "jaxvib.results", "jaxvib.units"),
    ("jaxvib.numerics", "jaxvib.display"),
    ("jaxvib.runtime",),
    ("jaxvib.boundary",),
    ("jaxvib.errors", "jaxvib.code_changes"),
)
"""Floors from the top down; a module may import from its own package and from floors below its own."""

MOST_FILES, MOST_LINES = 12, 600


def sources():
    """Every module of the two packages by its dotted name."""
    files = [path for package in ("jaxvib", "optimize") for path in sorted((ROOT / package).rglob("*.py"))]
    return {
        ".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__"): path.read_text() for path in files
    }


@functools.cache
def statements(text):
    """The import statements of a module, those inside functions too."""
    return [node for node in ast.walk(ast.parse(text)) if isinstance(node, (ast.Import, ast.ImportFrom))]


def imports(modules):
    """(module, imported module) for every import statement, those inside functions too."""
    found = set()
    for module, text in modules.items():
        for node in statements(text):
            if isinstance(node, ast.ImportFrom) and node.module and not node.level:
                # `from package import module` imports the module, `from module import name` the module of the name.
                for alias in node.names:
                    inner = f"{node.module}.{alias.name}"
                    found.add((module, inner if inner in modules else node.module))
            else:
                found |= {(module, alias.name) for alias in node.names}
    return {(module, other) for module, other in found if other.split(".")[0] in ("jaxvib", "optimize")}


def floor_of(module):
    """(floor counted from below, package); the package `jaxvib` itself, the list of public names, has none."""
    for height, packages in enumerate(reversed(FLOORS)):
        for package in packages:
            if module == package or module.startswith(package + "."):
                return height, package
    return None, None


def upward(modules):
    """Imports that do not go down: to a floor above, or to another package of the same floor."""
    found = []
    for module, other in sorted(imports(modules)):
        (here, mine), (there, theirs) = floor_of(module), floor_of(other)
        public = mine in ("jaxvib.cli", "optimize") and other == "jaxvib"  # the face may use the public names
        if module == "jaxvib" or public:
            continue
        if here is None or there is None or (mine != theirs and there >= here):
            found.append(f"{module} imports {other}")
    return found


def circles(modules):
    """Modules that import each other, directly or through others, in groups."""
    below = collections.defaultdict(set)
    for module, other in imports(modules):
        if other != "jaxvib":
            below[module].add(other)

    def reached(start):
        seen, todo = set(), [start]
        while todo:
            for other in below[todo.pop()]:
                if other not in seen:
                    seen.add(other)
                    todo.append(other)
        return seen

    every = {module: reached(module) for module in list(below)}
    return sorted(
        {tuple(sorted(m for m in every[module] if module in every.get(m, ()))) for module in every if module in every[module]}
    )


def test_imports_go_down():
    assert upward(sources()) == []


def test_modules_do_not_import_each_other():
    assert circles(sources()) == []


@pytest.mark.parametrize(
    ("module", "line", "says"),
    [
        (
            "jaxvib.equations.linear",
            "from jaxvib.motion.simulate import simulate",
            "equations.linear imports jaxvib.motion.simulate",
        ),
        ("jaxvib.ode.control", "    from jaxvib.machine.scene import Scene", "ode.control imports jaxvib.machine.scene"),
        ("jaxvib.machine.scene", "import jaxvib", "machine.scene imports jaxvib"),
        ("optimize.space", "from jaxvib.study.maps import run_up_map", "optimize.space imports jaxvib.study.maps.run_up_map"),
    ],
)
def test_an_import_turned_round_is_seen(module, line, says):
    modules = sources()
    body = f"def f():\n{line}\n" if line.startswith(" ") else line + "\n"
    assert any(says in found for found in upward({**modules, module: modules[module] + "\n\n" + body}))


def test_a_circle_is_seen():
    modules = sources()
    turned = modules["jaxvib.machine.carrier"] + "\n\nfrom jaxvib.machine.scene import Scene\n"
    assert any("jaxvib.machine.scene" in group for group in circles({**modules, "jaxvib.machine.carrier": turned}))


PLANS = (
    "jaxvib.runtime",
    "jaxvib.units",
    "jaxvib.boundary",
    "jaxvib.machine.validation",
    "jaxvib.steady.outcome",
    "jaxvib.motion.plan",
    "jaxvib.steady.orbits.jam_orbit",
    "jaxvib.steady.orbits.synchronous",
    "optimize.quantities.evaluation",
)
"""Modules that may ask whether numbers have values, and those in them; constructors use `when_known`."""


ASKED = ("jaxvib.runtime.compat", "jaxvib.units", "jaxvib.units.known")


def asking(modules):
    """Modules, other than plans, that import a question whether a number has a value, or name JAX's class of tracers."""
    found = []
    for module, text in modules.items():
        lines = [node for node in statements(text) if isinstance(node, ast.ImportFrom) and node.module in ASKED]
        imported = {alias.name for node in lines for alias in node.names}
        named = {node.attr for node in ast.walk(ast.parse(text)) if isinstance(node, ast.Attribute)}
        if (imported & {"traced", "is_known"} or named & {"traced", "Tracer"}) and not module.startswith(PLANS):
            found.append(module)
    return found


def test_only_plans_ask_which_numbers_are_known():
    assert asking(sources()) == []


def test_a_question_about_tracers_elsewhere_is_seen():
    lines = "from jaxvib.units.known import is_known\n\n\ndef f(x):\n    return is_known(x)\n"
    assert asking({"jaxvib.equations.linear": lines}) == ["jaxvib.equations.linear"]


def test_folders_and_files_are_small():
    folders, long = collections.Counter(), []
    for part in ("jaxvib", "optimize", "tests", "benchmarks"):
        for path in (ROOT / part).rglob("*.py"):
            folders[path.parent.relative_to(ROOT)] += path.name != "__init__.py"
            lines = len(path.read_text().splitlines())
            if lines > MOST_LINES:
                long.append(f"{path.relative_to(ROOT)}: {lines} lines")
    assert {str(folder): count for folder, count in folders.items() if count > MOST_FILES} == {}
    assert long == []


def lengths_of_functions(text):
    """(name, number of lines without the docstring) of every function in the text of a module."""
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, (ast.FunctionDef, ast.AsyncFunctionDef)):
            docstring = node.body[0] if ast.get_docstring(node) is not None else None
            ignored = 0 if docstring is None else docstring.end_lineno - docstring.lineno + 1
            yield node.name, node.end_lineno - node.lineno + 1 - ignored


def test_functions_have_at_most_60_lines():
    assert list(lengths_of_functions('def f():\n    """A\n\n    B."""\n    return 1\n')) == [("f", 2)]
    found = [(module, *each) for module, text in sources().items() for each in lengths_of_functions(text)]
    assert [each for each in found if each[-1] > 60] == []


def test_contributing_names_every_package():
    page = (ROOT / "CONTRIBUTING.md").read_text()
    packages = {package.replace(".", "/") for floor in FLOORS for package in floor}
    assert not {package for package in packages if f"`{package}`" not in page}


def test_every_module_has_a_docstring():
    assert [name for name, text in sources().items() if text.strip() and ast.get_docstring(ast.parse(text)) is None] == []


def test_names_of_test_files_are_unique():
    """Test folders are no packages, so that pytest imports each file by its name alone."""
    names = collections.Counter(path.name for path in (ROOT / "tests").rglob("test_*.py"))
    assert not [name for name, count in names.items() if count > 1]


def without_encoding(modules):
    """Modules that read or write texts in the encoding of the platform, without examples of docstrings."""
    for module, text in modules.items():
        for node in ast.walk(ast.parse(text)):
            if isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute):
                name, mode = node.func.attr, node.args[0] if node.args else ast.Constant("r")
                opens_text = name == "open" and isinstance(mode, ast.Constant) and "b" not in mode.value
                if (opens_text or name in ("read_text", "write_text")) and "encoding" not in {
                    each.arg for each in node.keywords
                }:
                    yield f"{module}: {ast.unparse(node)}"


def test_files_of_text_are_in_utf_8_on_every_platform():
    found = list(without_encoding({"m": "path.write_text('ö')\npath.open('w')\npath.open('rb')\nImage.open(file)\n"}))
    assert found == ["m: path.write_text('ö')", "m: path.open('w')"]
    assert list(without_encoding(sources())) == []
