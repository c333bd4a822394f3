# SPDX-License-Identifier: Apache-2.0

"""The inputs of kernels: hypotheses, each of which adds objects to a scene."""

from typing import NamedTuple

from jaxtyping import Array, Bool, Float, Int


class RenderedHypotheses(NamedTuple):
    """What each of N hypotheses adds to its scene: K objects and a plane."""

    type: Int[Array, "N K"]
    T_camera_object: Float[Array, "N K 4 4"]
    plane: Float[Array, "N 4"]  # n and n . o in the camera, of a plane seen from the side that n points to; 0: none
    everywhere: Bool[Array, ""] | bool = False  # whether the plane is there: then the whole image may change


class SceneDepths(NamedTuple):
    """Scenes to which hypotheses are added, as depth images with a border (`pad_scene`), and the scene of each
    hypothesis."""

    depth: Float[Array, "A Hp Wp"]
    ancestor: Int[Array, "N"]
