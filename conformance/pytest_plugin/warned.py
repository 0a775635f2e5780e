"""The warning that a device breaks a `should`."""

import pytest


class EcatWarning(pytest.PytestWarning):
    """The device does not do what its text says it should; a broken `must` is a failure."""
