# SPDX-License-Identifier: Apache-2.0

"""Which objects of samples descend from one draw of the sampler."""

import numpy as np

from bayes3d_ros.parsing.samples import _apart, _draws


def test_stages_share_no_draws() -> None:
    stages = [np.array([[0, -1], [0, -1]]), np.zeros((0, 2), int), np.array([[3, 5], [3, 0]])]
    numbers = _apart(stages)
    assert numbers.shape == (4, 2)
    assert numbers[0, 0] == numbers[1, 0] and numbers[2, 0] == numbers[3, 0]  # copies stay copies
    assert not {*numbers[:2, 0]} & {*numbers[2:].ravel()}


def test_a_known_object_has_its_lineage_and_a_thing_of_no_type_its_scene() -> None:
    """Four samples of two scenes, which hold one and two known objects, then things of no type."""
    lineage = np.repeat([[4, -1], [4, 7]], 2, axis=0)
    held = np.repeat([[True, True, False, False], [True, True, True, False]], 2, axis=0)
    draw = _draws(lineage, held, np.repeat([1, 2], 2))
    np.testing.assert_array_equal(draw < 0, ~held)
    assert draw[:, 0].tolist() == [4] * 4 and draw[2:, 1].tolist() == [7, 7]
    first, second = draw[:2, 1], draw[2:, 2]
    assert len({*first}) == len({*second}) == 1  # both signs of a scene's errors are one draw
    assert not {*first} & {*second} and not {*first, *second} & {4, 7}
