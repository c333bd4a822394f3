# SPDX-License-Identifier: Apache-2.0

"""What a setting is: a field of a frozen dataclass with a description, a unit and a range, from which ROS parameters,
options of commands and yaml files are made."""

from collections.abc import Collection
from dataclasses import Field, field, fields
from typing import Any, get_args

# Retired names of settings, and the names that took their place. Whoever still gives one is told.
RETIRED = {
    "rejuvenation": "rejuvenated_objects",
    "reheating": "tempering_steps",
    "pixel_weight": "model_error",
    "depth_bias": "surface_bias",
    "depth_waviness": "surface_waves",
    "waviness_length": "wave_length",
    "table_height_sigma": "camera_position_sigma",
    "table_tilt_sigma": "camera_angle_sigma",
}


def retirement(name: str, known: Collection[str]) -> str:
    """What to tell somebody who gives a retired name; empty where it is none, or the new one is not among the known."""
    new = RETIRED.get(name)
    return f"this name is retired, use {new}" if new in known else ""


class UnfinishedSettings(ValueError):
    """Settings that belong together, of which only some are given: nothing can be done with them, but the others may
    follow, as `ros2 param set` sets one at a time."""


def setting(default: Any, description: str, *, unit: str = "", low: Any = None, high: Any = None, choices=()) -> Any:
    """A dataclass field that knows its description, unit and range."""
    return field(
        default=default,
        metadata={"description": description, "unit": unit, "low": low, "high": high, "choices": tuple(choices)},
    )


def element_type(field: Field) -> type:
    """Of a setting that is a list, a tuple of any length: the type of its elements."""
    element: type = get_args(field.type)[0]
    return element


def validate(settings: Any) -> None:
    """Raise ValueError, naming the field, where a setting lies outside its range."""
    for f in fields(settings):
        value, meta = getattr(settings, f.name), f.metadata
        if meta.get("choices") and value not in meta["choices"]:
            raise ValueError(f"{f.name} must be one of {', '.join(meta['choices'])}, got {value!r}")
        low, high = meta.get("low"), meta.get("high")
        # Not `value < low`: NaN is out of every range.
        if (low is not None and not value >= low) or (high is not None and not value <= high):
            ends = {(False, False): f"lie in [{low}, {high}]", (False, True): f"be at least {low}"}
            expected = ends.get((low is None, high is None), f"be at most {high}")
            raise ValueError(f"{f.name} must {expected} {meta['unit']}".rstrip() + f", got {value}")
