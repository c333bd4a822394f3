# SPDX-License-Identifier: Apache-2.0

"""Whether the packages that networks need are here."""

from importlib.util import find_spec

PACKAGES = ("equinox", "optax")


class NetworksMissingError(Exception):
    """One line that says what is not installed, and how to install it."""


def require_networks() -> None:
    """Raise NetworksMissingError where a package is missing."""
    missing = [name for name in PACKAGES if find_spec(name) is None]
    if missing:
        raise NetworksMissingError(
            f"networks need {' and '.join(missing)}, not installed: pip install 'bayes3d_ros[experiments]'"
        )
