"""Examples in docstrings as code: a paragraph of `>>>` becomes a block of the language `pycon`."""

import re

import griffe

_EXAMPLE = re.compile(r"(?:^|(?<=\n\n))(>>> .*?)(?=\n\n|\Z)", flags=re.S)


class Examples(griffe.Extension):
    """Fences every example of every docstring."""

    def on_instance(self, *, obj, **_):
        """Called by griffe for every object that it has read."""
        if obj.docstring:
            obj.docstring.value = _EXAMPLE.sub(r"```pycon\n\1\n```", obj.docstring.value)
