# SPDX-License-Identifier: Apache-2.0

"""How much there is to keep of a library: files, and arrays in memory."""

import tempfile
from pathlib import Path
from typing import NamedTuple

from bayes3d_ros.objects.library_arrays import LibraryArrays, library_arrays
from bayes3d_ros.objects.model import Library
from bayes3d_ros.objects.store import save_model


class ModelSizes(NamedTuple):
    """Bytes."""

    files: tuple[int, ...]  # one a model
    memory: int  # arrays that scenes are rendered and searched with, of the library's own types and voxels
    padded_memory: int  # the same as they are allocated: sizes are padded so that a library may grow


def model_sizes(library: Library) -> ModelSizes:
    """The sizes of a library's models."""
    with tempfile.TemporaryDirectory(prefix="bayes3d-model-sizes-") as folder:
        files = tuple(save_model(model, Path(folder)).stat().st_size for model in library.models)
    arrays = library_arrays(library)
    # A grid for each octant of directions, and two planes for every edge.
    words = sum(8 * model.occupancy.size + 2 * int(model.at_edge.sum()) for model in library.models)
    return ModelSizes(files, _own_bytes(arrays, words), sum(array.nbytes for array in arrays))


def _own_bytes(arrays: LibraryArrays, words: int) -> int:
    own, padded = int(arrays.num_types), len(arrays.first)
    types = [array for name, array in arrays._asdict().items() if name != "words" and array.ndim]
    return words * arrays.words.dtype.itemsize + sum(array.nbytes * own // padded for array in types)
