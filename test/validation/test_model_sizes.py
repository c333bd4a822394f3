# SPDX-License-Identifier: Apache-2.0

"""Sizes of models in files and in memory."""

import numpy as np

from bayes3d_ros.objects.library_arrays import library_arrays
from bayes3d_ros.objects.model import Library
from bayes3d_ros.validation.statistics.model_sizes import model_sizes


def test_memory_of_a_library_is_that_of_its_models_and_padding_is_told_apart(library):
    """All arrays but the number of types have a part for each type, or are its eight grids."""
    whole, parts = model_sizes(library), [model_sizes(Library((model,))) for model in library.models]
    assert whole.files == tuple(size for part in parts for size in part.files)
    assert whole.memory == sum(part.memory for part in parts)
    box = library.models[1]
    assert parts[1].memory > 8 * 4 * np.prod(box.occupancy.shape)
    assert whole.padded_memory == sum(array.nbytes for array in library_arrays(library)) > whole.memory
