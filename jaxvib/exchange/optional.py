"""Import of optional packages, and checks of the paths of exports."""

from __future__ import annotations

import importlib
from pathlib import Path
from typing import Any

from jaxvib.errors import InputError, quoted


def optional_module(name: str, extra: str) -> Any:
    """Import a module of an optional package. If it is missing, **raises** `InputError` with the command that installs it."""
    try:
        return importlib.import_module(name)
    except ImportError as error:
        package = name.partition(".")[0]
        raise InputError(package, f"is not installed; install it with: pip install '.[{extra}]'") from error


def require_writable(path: Path) -> None:
    """Check that a file can be written, before the computation begins.

    **Raises** `InputError` for a missing folder, a read-only file and a name that is not allowed.
    """
    try:
        if not path.parent.is_dir():
            raise InputError("path", f"is {quoted(str(path))}, and its folder does not exist; create it or name another one")
        if path.is_dir() or (path.exists() and not path.stat().st_mode & 0o222):
            kind = "a folder" if path.is_dir() else "read-only"
            raise InputError("path", f"is {quoted(str(path))}, which is {kind}; name another file")
    except OSError as error:
        problem = f"is {quoted(str(path))}, which cannot be written ({error.strerror}); name another file"
        raise InputError("path", problem) from error
