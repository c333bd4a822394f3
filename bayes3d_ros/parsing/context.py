# SPDX-License-Identifier: Apache-2.0

"""Image, library and table: what stays the same through one parse."""

from typing import NamedTuple

from bayes3d_ros.likelihood.scored_image import ScoredImage
from bayes3d_ros.objects.library_arrays import LibraryArrays
from bayes3d_ros.objects.placement import Table


class Context(NamedTuple):
    """What a frame and a library fix for a whole parse."""

    image: ScoredImage
    library: LibraryArrays
    table: Table
