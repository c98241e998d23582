"""Alias of the package `optimize`. It finds the package even if a file optimize.py lies beside a user's script."""

import importlib.util
import sys
from pathlib import Path
from types import ModuleType
from typing import Any


def _package() -> ModuleType:
    """Return the package beside `jaxvib`, not the first `optimize` on the path.

    **Raises** `ImportError` if another module of this name was imported.
    """
    source = Path(__file__).parents[1] / "optimize" / "__init__.py"
    imported = sys.modules.get("optimize")
    if imported is not None:
        if Path(getattr(imported, "__file__", None) or "").resolve() != source.resolve():
            raise ImportError(
                f"the module 'optimize' is {getattr(imported, '__file__', imported)}, not the package of jaxvib; "
                "rename that module"
            )
        return imported
    spec = importlib.util.spec_from_file_location("optimize", source, submodule_search_locations=[str(source.parent)])
    assert spec is not None and spec.loader is not None
    package = sys.modules["optimize"] = importlib.util.module_from_spec(spec)
    try:
        spec.loader.exec_module(package)
    except BaseException:
        del sys.modules["optimize"]
        raise
    return package


def __getattr__(name: str) -> Any:
    return getattr(_package(), name)


def __dir__() -> list[str]:
    return dir(_package())
