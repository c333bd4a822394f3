# SPDX-License-Identifier: Apache-2.0

"""Growth of cost, from made-up rows."""

import pytest

from bayes3d_ros.validation.bench.speed_rows import growth, speed_row


def test_rows_are_medians():
    row = speed_row("score", "ours", "cpu", 25, 100, [4.0, 1.0, 2.0], bag="x")
    assert (row["seconds"], row["seconds_min"], row["seconds_max"], row["bag"]) == (2.0, 1.0, 4.0, "x")
    assert row["per_second"] == 50 and speed_row("parse", "ours", "cpu", "8x6", None, [4.0])["per_second"] == 0.25


def test_growth_is_one_where_cost_is_linear():
    def scored(hypotheses, seconds, size=25):
        return speed_row("render+score", "ours", "cpu", size, hypotheses, [seconds])

    def parsed(bag, library, objects, seconds):
        return speed_row("parse", "ours", "cpu", "8x6", None, [seconds], bag=bag, library=library, objects=objects)

    peaks = {"frames": 50, "peak_mib": 110.0, "peak_mib_at_first": 100.0}
    rows = [
        scored(1, 0.5),
        scored(256, 1.0),
        scored(2048, 8.0),
        scored(16384, 32.0),
        scored(2048, 9.0, 50),
        speed_row("render", "ours", "cpu", 25, 2048, [1.0]),
        parsed("one_object", 1, 1, 1.0),
        parsed("one_object", 10, 1, 2.0),
        parsed("three_objects", 10, 3, 12.0),
        parsed("table_of_1", 10, 1, 2.0),
        parsed("table_of_4", 10, 4, 5.0),
        parsed("table_of_4_from_last", 10, 4, 7.0),
        parsed("real_clutter", 10, 5, 99.0),
        speed_row("memory", "ours", "cpu", "8x6", None, [1.0], **peaks),
    ]
    assert growth(rows) == {
        "seconds a hypothesis, 2048 / 256, 25 pixels": 1.0,
        "seconds a hypothesis, 16384 / 2048, 25 pixels": 0.5,
        "seconds an object, 4 / 1": 0.75,
        "seconds a type, 10 / 1, one_object": pytest.approx(0.2),
        "peak memory after 50 frames / after a few": 1.1,
    }
