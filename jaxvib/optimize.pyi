"""Names of the package `optimize`, for type checkers."""

from optimize import *  # noqa: F403

# mypy does not read the additions to `__all__` in `optimize/__init__.py`.
from optimize.quantities.exciters import *  # noqa: F403
from optimize.quantities.jams import *  # noqa: F403
from optimize.quantities.machine import *  # noqa: F403
from optimize.quantities.motion import *  # noqa: F403
from optimize.quantities.response import *  # noqa: F403
from optimize.quantities.severity import *  # noqa: F403
