# SPDX-License-Identifier: Apache-2.0

"""A compiled parser, with what a node needs beside it."""

from collections.abc import Callable
from typing import NamedTuple, Protocol

import jax

from bayes3d_ros.geometry.depth_frame import DepthFrame
from bayes3d_ros.jax_runtime import compute_likelihood
from bayes3d_ros.objects.model import Library, type_names
from bayes3d_ros.posterior.types import ScenePosterior
from bayes3d_ros.ros.markers import SceneMarkers
from bayes3d_ros.ros.planning_scene import CollisionMeshes
from bayes3d_ros.settings import ParserSettings


class Parser(Protocol):
    """What a node needs of a parser; see parsing/parser.py."""

    library: Library
    settings: ParserSettings

    def warm_up(self, width: int, height: int) -> None: ...

    def compiled_for(self, width: int, height: int) -> bool: ...

    def parse(self, frame: DepthFrame) -> ScenePosterior: ...

    def changed(self, settings: ParserSettings) -> "Parser": ...


MakeParser = Callable[[Library, ParserSettings, int], Parser]  # the last: its capacity, in objects
LEAST_CAPACITY = 12  # objects that a node compiles for


class ParserBundle(NamedTuple):
    """A compiled parser, markers and meshes for its library, and the name of JAX's backend."""

    parser: Parser
    markers: SceneMarkers
    meshes: CollisionMeshes
    backend: str


def types_of(parser: Parser) -> tuple[str, ...]:
    """Names of the types that `type` in ~/posterior counts."""
    return type_names(parser.library, parser.settings.knows_unknown)


def make_bundle(
    make_parser: MakeParser, library: Library, settings: ParserSettings, size: tuple[int, int], capacity: int
) -> ParserBundle:
    """Compile for images of a size (width, height; none if one is 0) and scenes of up to `capacity` objects. Takes
    seconds to minutes. The process computes on the CPU from then on where the likelihood needs one."""
    compute_likelihood(settings.likelihood)
    parser = make_parser(library, settings, capacity)
    if all(size):
        parser.warm_up(*size)
    return ParserBundle(parser, SceneMarkers(library), CollisionMeshes(library), jax.default_backend())
