"""Names of the package `optimize`, for type checkers."""

from optimize import *  # noqa: F403
