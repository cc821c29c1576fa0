"""The error class of the package. This module imports nothing, so that a wrong call is answered at once."""

from __future__ import annotations


class CFlowError(ValueError):
    """The only error that this package raises for bad input, bad files and bad settings.

    The message says what you passed, what is allowed, and what to do.
    """
