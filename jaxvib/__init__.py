"""Differentiable simulation and design of vibration machines that work on the Sommerfeld effect."""

import ast
import importlib
from pathlib import Path
from typing import Any

import jaxvib.code_changes  # noqa: F401  before all other modules, because it watches their imports


def _modules_of_names() -> dict[str, str]:
    """Return the module of each public name, read from the imports of the stub `__init__.pyi`."""
    stub = ast.parse(Path(__file__).with_suffix(".pyi").read_text(encoding="utf-8"))
    imports = [node for node in stub.body if isinstance(node, ast.ImportFrom)]
    return {alias.name: str(node.module) for node in imports for alias in node.names}


_MODULE_OF_NAME = _modules_of_names()
__all__ = sorted(_MODULE_OF_NAME)  # pyright: ignore[reportUnsupportedDunderAll]


def __getattr__(name: str) -> Any:
    """Return a public name; its module is imported at the first use, so that a command imports only what it needs."""
    if name == "__version__":
        from importlib.metadata import version  # slow import

        return version("jaxvib")
    if name not in _MODULE_OF_NAME:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    # `start` calls `prepare_cpu` and `use_cache` with default arguments. These two functions, which a user may call first with
    # other arguments, are in `jaxvib.runtime`.
    if not _MODULE_OF_NAME[name].startswith(("jaxvib.errors", "jaxvib.runtime")):
        from jaxvib.runtime.startup import start

        start()
    value = globals()[name] = getattr(importlib.import_module(_MODULE_OF_NAME[name]), name)
    return value


def __dir__() -> list[str]:
    return sorted({*__all__, "__version__", *(name for name in globals() if name.startswith("__"))})
