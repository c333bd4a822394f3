# SPDX-License-Identifier: Apache-2.0

"""What the score-width experiment says of made-up rows."""

import pytest

from bayes3d_ros.validation.experiments import score_width


def rows_of(position: dict[int, float], p_true: dict[int, float]) -> list[dict]:
    """Three frames of each kind, of these widths (metres) and probabilities at every score_width; one lacks yaw."""
    rows = []
    for frame in range(3):
        for width in score_width.WIDTHS:
            own = {"position": position[width] * (frame + 1), "yaw": None if frame == 0 else 0.1, "p_true": 0.9}
            rows.append(score_width._empty_row("ten types", frame, "025_mug", width) | own | {"seconds": 1.0})
            pair = {"p_true": p_true[width], "seconds": 1.0}
            rows.append(score_width._empty_row("similar types", frame, "box", width) | pair)
    return rows


def test_widths_are_compared_frame_by_frame(tmp_path) -> None:
    rows = rows_of({120: 0.011, 160: 0.010, 240: 0.006}, {120: 0.5, 160: 0.55, 240: 0.3})
    failed = score_width._empty_row("ten types", 9, "025_mug", 240) | {"error": "no table in sight"}
    told = score_width.summary([*rows, failed])
    assert told["score_width 120"]["position ratio"] == pytest.approx(1.1, abs=1e-4)
    assert told["score_width 240"]["position ratio"] == pytest.approx(0.6, abs=1e-4)
    assert told["score_width 240"]["position ratio_error"] == pytest.approx(0.0, abs=1e-6)
    assert told["score_width 240"]["yaw ratio"] == 1.0
    assert told["score_width 240"]["p(true), similar types"] == pytest.approx(0.3)
    assert told["not_met"] == ["score_width 240: p(type), similar types", "score_width 240: position"]
    assert "no table in sight" in score_width.line(failed) and "-" in score_width.line(rows[0])
    assert all(path.stat().st_size > 1000 for path in score_width.plot(rows, tmp_path))


def test_where_nothing_differs_nothing_is_missed() -> None:
    same = dict.fromkeys(score_width.WIDTHS, 0.5)
    assert score_width.summary(rows_of(same, same))["not_met"] == []
    assert score_width.summary([]) == {"not_met": []}
