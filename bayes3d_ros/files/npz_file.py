# SPDX-License-Identifier: Apache-2.0

"""Arrays of .npz files that others may have written or damaged; and small files of arrays."""

import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import BinaryIO

import numpy as np

MOST_BYTES = 2**28  # of all arrays together; models and captures hold a few megabytes


def read_arrays(path: Path) -> dict[str, np.ndarray]:
    """All arrays of a file, by name. Raises ValueError, one line, where it cannot be read as such, holds pickles, or is
    larger than any file of ours; OSError where the file itself cannot be read."""
    with path.open("rb") as file:
        try:
            if not zipfile.is_zipfile(file):
                raise ValueError("not a .npz file, or cut short")
            with zipfile.ZipFile(file) as entries:
                size = sum(entry.file_size for entry in entries.infolist())
            if size > MOST_BYTES:
                raise ValueError(f"its arrays take {size} bytes, expected {MOST_BYTES} at most")
            file.seek(0)
            with np.load(file, allow_pickle=False) as arrays:
                found = {name: arrays[name] for name in arrays.files}
        except OSError:
            raise
        # A header that lies about its array's size is a MemoryError; else zipfile, zlib, numpy and Python's own parser,
        # which reads the headers, each raise their own kinds.
        except Exception as error:
            reason = " ".join(str(error).split())[:120] or type(error).__name__
            raise ValueError(reason) from error
    if not all(isinstance(array, np.ndarray) for array in found.values()):
        raise ValueError("holds entries that are no arrays")
    return found


def write_arrays(file: BinaryIO, arrays: Mapping[str, np.ndarray]) -> None:
    """What `np.load` reads, an eighth smaller than what `np.savez_compressed` writes. The same arrays give the same
    bytes."""
    with zipfile.ZipFile(file, "w") as entries:
        for name, array in arrays.items():
            entry = zipfile.ZipInfo(f"{name}.npy")
            entry.compress_type = zipfile.ZIP_LZMA
            with entries.open(entry, "w") as part:
                np.lib.format.write_array(part, array, allow_pickle=False)
