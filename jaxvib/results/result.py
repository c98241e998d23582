"""Common base of all results."""

# No postponed annotations in this module: Equinox recognizes an abstract field by its evaluated annotation.

import abc
import base64
import html
import io
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self, final

import equinox as eqx

from jaxvib.boundary import validated
from jaxvib.display import Figure
from jaxvib.errors import InputError, optional_module, quoted
from jaxvib.results import fields, files
from jaxvib.results.csv import main_axis, table_along
from jaxvib.results.readable import Readable
from jaxvib.results.status import sentence, status_name

if TYPE_CHECKING:
    import pandas
    import xarray


class Result(Readable):
    """Base of all results: numbers with a status.

    - `status`, and its sentence `message`
    - as text and figure: `summary()`, which is also the representation, and `plot()`
    - as data: plain values `as_dict()`, a table `to_pandas()`, a labelled dataset `to_xarray()`
    - in a file: `save(path)`, `load(path)`
    - comparison: `==` is True if all fields are equal (of two runs also the computing time), with NaN equal to NaN

    The contents of data and files follow from the fields: the metadata of each field contain its unit and the names of its axes
    (`jaxvib.results.fields`). A result class is final: no other class inherits from it.

    >>> import jaxvib as jv
    >>> scene = jv.Scene(jv.one_mass(mass=50.0, stiffness=4e4, damping=30.0),
    ...                  jv.balls(count=2, mass=0.5, radius=0.1, drag=1.0), jv.ConstantSpeed(100.0))
    >>> shapes = jv.mode_shapes(scene)
    >>> shapes.status_name, list(shapes.as_dict())
    ('done', ['status', 'message', 'frequency', 'shape', 'lever', 'coordinates'])
    """

    outer_axes = ()
    """Names of the axes for which "*" stands in the metadata of fields, see `jaxvib.results.fields.in_unit`."""

    if TYPE_CHECKING:  # type checkers see the abstract field as a field that is not an argument of the constructor
        status: Any = eqx.field(init=False)
    else:
        status: eqx.AbstractVar[eqx.Enumeration]

    @property
    @final
    def message(self) -> str:
        """Sentence of the status; for several statuses, each different sentence once, with its number of occurrences."""
        return sentence(self.status)

    @property
    @final
    def status_name(self) -> str:
        """Name of a single status, such as "found"."""
        return status_name(self.status)

    @abc.abstractmethod
    def summary(self) -> str:
        """Return the result as text for a reader."""

    @abc.abstractmethod
    def plot(self) -> "Figure":
        """Plot the result by matplotlib.

        **Arguments** (some results do not have them): `unit` of speeds, "rad/s", "rpm" or "Hz"; `ax`: axes to draw onto, one
        for each panel.

        **Returns** a matplotlib figure, or the given `ax`. **Raises** `InputError` for another unit or number of axes.
        """

    def _repr_html_(self) -> str:
        """Return the representation and, for a single result, its figure, for notebooks."""
        text = f"<pre>{html.escape(repr(self))}</pre>"
        if not fields.is_single(self):
            return text
        try:
            figure = self.plot()
        except InputError:  # the result lacks the data of its figure, such as a run saved without its trajectory
            return text
        data = io.BytesIO()
        figure.savefig(data, format="png", dpi=80)
        return f'{text}<img alt="figure" src="data:image/png;base64,{base64.b64encode(data.getvalue()).decode()}">'

    @final
    def as_dict(self) -> "dict[str, fields.Plain]":
        """Return the result as plain Python values, ready for JSON, see `jaxvib.results.fields.as_dict`.

        These values do not determine the result: the way to store a result and to read it back is `save` and `load`.
        """
        return fields.as_dict(self)

    @final
    def to_xarray(self) -> "xarray.Dataset":
        """Return the result as a labelled dataset with units, see `jaxvib.results.fields.to_xarray`."""
        return fields.to_xarray(self)

    @final
    @validated
    def to_pandas(self, axis: str | None = None) -> "pandas.DataFrame":
        """Return the arrays of the result along one axis as a table with a row for each point, with the columns of `write_csv`.

        **Arguments**: `axis`: its name, such as "time", "mode" or "rotor_speed"; default: the axis of most arrays.

        **Raises** `InputError` for an axis that the result does not have, and if pandas is not installed
        (`pip install '.[xarray]'`).
        """
        return optional_module("pandas", "xarray").DataFrame(table_along(self, main_axis(self) if axis is None else axis))

    @final
    @validated
    def save(self, path: str | Path) -> Path:
        """Write the result to the NumPy archive `path` (".npz") that `load` reads back bit for bit. **Returns** the path."""
        return files.save(self, path)

    @classmethod
    @final
    @validated
    def load(cls, path: str | Path) -> Self:
        """Read a result of this class written by `save` to the file `path`.

        **Raises** `InputError` for a file that is missing or contains something else.
        """
        result = files.load(path)
        if not isinstance(result, cls):
            raise InputError(
                "path", f"is {quoted(str(path))}; it contains a result of class {type(result).__name__}, not {cls.__name__}"
            )
        return result
