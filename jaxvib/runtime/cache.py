"""Folder in which traced and compiled programs are cached on disk."""

from __future__ import annotations

import contextlib
import os
import stat
from collections.abc import Iterator
from pathlib import Path

import jax

from jaxvib.boundary import validated
from jaxvib.errors import InputError
from jaxvib.runtime.compat import user_folder
from jaxvib.runtime.devices import jax_option

_program_folder: list[Path] = []
"""Folder of traced programs as a list of one entry; empty if programs are not stored."""


@validated
def use_cache(folder: str | os.PathLike[str] | None = None, *, only_if_unset: bool = False) -> Path:
    """Cache programs on disk. Another process that runs the same program then neither traces nor compiles it.

    - There are two caches: jaxvib's own cache of traced programs in `folder/programs`, and JAX's compilation cache of compiled
      programs in `folder` itself (`jax_compilation_cache_dir` is not changed if it is already set)
    - jaxvib calls this function with the default folder, unless JAXVIB_AUTOMATIC=off in the environment
    - Programs that differ in shapes, in options, in a version of jaxvib or JAX, or in the CPU have different keys. The
      folder may be deleted at any time
    - A program that calls back into Python, such as one with a progress bar, cannot be stored
    - No program is stored or read while a function or a constant of the package is replaced, for example by a mock. The same
      applies if a source file was edited after its import

    **Arguments**

    - `folder`, which is created if it does not exist; default: that of JAX's compilation cache if it is set, otherwise
      `$XDG_CACHE_HOME/jaxvib`, otherwise `~/.cache/jaxvib`
    - `only_if_unset`: True keeps a folder that was chosen before

    **Returns** the folder. **Raises** `InputError` for a folder that cannot be created, that belongs to another user, or in
    which others may write: users with write access to it can run code with your rights.

    >>> import jaxvib as jv
    >>> jv.use_cache("/dev/null")           # doctest: +IGNORE_EXCEPTION_DETAIL
    Traceback (most recent call last):
        ...
    jaxvib.errors.InputError: folder is '/dev/null'; it must be a folder that can be written to (Not a directory)
    """
    if only_if_unset and _program_folder:
        return _program_folder[0].parent
    path = (default_folder() if folder is None else Path(folder)).expanduser().absolute()
    programs = path / "programs"
    try:
        programs.mkdir(mode=0o700, parents=True, exist_ok=True)
    except OSError as error:
        raise InputError("folder", f"is '{path}'; it must be a folder that can be written to ({error.strerror})") from error
    for place in (path, programs):
        require_own(place)
    if jax_option("jax_compilation_cache_dir") is None:
        jax.config.update("jax_compilation_cache_dir", str(path))
        jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
    set_program_folder(programs)
    return path


def default_folder() -> Path:
    """Return the folder in which programs are cached by default."""
    folder_of_jax = jax_option("jax_compilation_cache_dir")
    return Path(folder_of_jax or user_folder())


def set_program_folder(folder: Path | None) -> None:
    """Set the folder of traced programs; None disables their storage."""
    _program_folder[:] = [] if folder is None else [folder]


def program_folder() -> Path | None:
    """Return the folder of traced programs, or None if programs are not stored."""
    return _program_folder[0] if _program_folder else None


@contextlib.contextmanager
def compiled_anew() -> Iterator[None]:
    """Disable both caches within the context, to measure the compile times of programs that this process has not used yet."""
    folder, enabled = program_folder(), bool(jax_option("jax_enable_compilation_cache"))
    set_program_folder(None)
    jax.config.update("jax_enable_compilation_cache", False)
    try:
        yield
    finally:
        set_program_folder(folder)
        jax.config.update("jax_enable_compilation_cache", enabled)


def require_own(folder: Path) -> None:
    """Raise `InputError` if another user owns a folder or may write to it. The same applies to a folder above it that belongs
    to another user (except root), or whose contents every user can replace."""
    if not hasattr(os, "geteuid"):  # on Windows only the owner can write to a home folder
        return
    for place in (folder, *folder.resolve().parents):
        status = place.stat()
        mode = stat.S_IMODE(status.st_mode)
        if status.st_uid not in ((os.geteuid(),) if place == folder else (os.geteuid(), 0)):
            raise InputError("folder", f"is '{folder}'; it must belong to you, but '{place}' belongs to user {status.st_uid}")
        others = mode & (stat.S_IWGRP | stat.S_IWOTH if place == folder else stat.S_IWOTH)
        if others and not (mode & stat.S_ISVTX and place != folder):
            raise InputError(
                "folder", f"is '{folder}'; others can write to '{place}', which is not safe; run chmod go-w '{place}'"
            )
