# SPDX-License-Identifier: Apache-2.0

"""Files in yaml that people write."""

from pathlib import Path
from typing import Any

import yaml


def read_yaml(path: Path, what: str, error: type[Exception]) -> Any:
    """What a file holds. Raises `error`, one line that names the file, where it cannot be read or is no yaml."""
    try:
        return yaml.safe_load(path.read_text())
    except OSError as cause:
        raise error(f"{path}: expected a readable {what}: {cause.strerror}") from None
    except UnicodeDecodeError:
        raise error(f"{path}: expected a {what} in yaml, this is no text") from None
    except (yaml.YAMLError, ValueError, LookupError, AttributeError, RecursionError) as cause:
        # PyYAML lets pass what Python says of numbers and dates that are none.
        raise error(f"{path}: expected yaml: {' '.join(str(cause).split()) or type(cause).__name__}") from None
