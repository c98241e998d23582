"""Common base of all results."""

# No postponed annotations here: Equinox knows an abstract field by its annotation itself.

import abc
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self, final

import equinox as eqx

from jaxvib.boundary import validated
from jaxvib.errors import InputError, quoted
from jaxvib.results import fields, files
from jaxvib.results.status import sentence, status_name

if TYPE_CHECKING:
    import xarray
    from matplotlib.figure import Figure

__all__ = ["Result"]


class Result(eqx.Module):
    """An answer to a question: numbers, and what there is to know about them.

    Every result has a `status`, its sentence `message`, a text for a person `summary()`, a figure `plot()`, plain values
    `as_dict()`, a labelled dataset `to_xarray()`, and goes to a file and back by `save(path)` and `load(path)`. The last four
    follow from the fields: the metadata of each says its unit and the names of its axes (`jaxvib.results.fields`).
    A class that is a `Result` is final: none is made of another by inheritance.
    """

    outer_axes = ()
    """Names of the axes that "*" stands for in the metadata of fields."""

    if TYPE_CHECKING:  # to a type checker an abstract field is one that no constructor takes
        status: Any = eqx.field(init=False)
    else:
        status: eqx.AbstractVar[eqx.Enumeration]

    @property
    @final
    def message(self) -> str:
        """Sentence of the status; of several, each sentence once with its number of occurrences."""
        return sentence(self.status)

    @property
    @final
    def status_name(self) -> str:
        """The name of a single status, such as "found"."""
        return status_name(self.status)

    @abc.abstractmethod
    def summary(self) -> str:
        """Text of the result for a reader."""

    @abc.abstractmethod
    def plot(self) -> "Figure":
        """Figure of the result by matplotlib; `plot(ax=axes)` draws onto given axes, one for each panel, and returns them."""

    @final
    def as_dict(self) -> "dict[str, fields.Plain]":
        """The result as plain Python values, ready for JSON, see `jaxvib.results.fields.as_dict`."""
        return fields.as_dict(self)

    @final
    def to_xarray(self) -> "xarray.Dataset":
        """The result as a labelled dataset with units, see `jaxvib.results.fields.to_xarray`."""
        return fields.to_xarray(self)

    @final
    @validated
    def save(self, path: str | Path) -> Path:
        """Writes the result to a NumPy archive that `load` reads back bit for bit. **Returns** its path (".npz")."""
        return files.save(self, path)

    @classmethod
    @final
    @validated
    def load(cls, path: str | Path) -> Self:
        """Reads a result of this class written by `save`.

        **Raises** `InputError` for a file that is missing or that holds something else.
        """
        found = files.load(path)
        if not isinstance(found, cls):
            raise InputError("path", f"is {quoted(str(path))}; it is no {cls.__name__} but holds a {type(found).__name__}")
        return found
