"""Files that are replaced whole or not at all: who reads one meanwhile, or after a kill, finds the old or the new."""

import json
import os
from pathlib import Path
from typing import Any


def write_json(file: Path, content: Any) -> None:
    """JSON for people and programs; NaN is an error (ValueError). Raises OSError."""
    temporary = file.with_name(f".{file.name}.tmp")
    temporary.write_text(json.dumps(content, indent=1, allow_nan=False) + "\n")
    os.replace(temporary, file)
