# SPDX-License-Identifier: Apache-2.0

"""Settings that the parser, the learner and the tracker share. Fields of dataclasses belong to one class each, so these
are functions that make them."""

from typing import Any

from bayes3d_ros.settings.declaring import setting


def near_setting() -> Any:
    return setting(
        0.1,
        "smallest depth that counts as a measurement; smaller ones are treated as missing. Set it to the shortest "
        "range of the camera",
        unit="m",
        low=0.01,
        high=100.0,
    )


def far_setting(default: float) -> Any:
    return setting(
        default,
        "largest depth that counts as a measurement; larger ones are treated as missing. Set it beyond the far "
        "edge of the table",
        unit="m",
        low=0.1,
        high=100.0,
    )


def sigma_max_setting() -> Any:
    return setting(
        0.005,
        "largest standard deviation of the noise of a single depth measurement; every value from 0 to this is "
        "equally likely beforehand. Raise it for a noisy or distant camera",
        unit="m",
        low=1e-4,
        high=0.1,
    )


def seed_setting() -> Any:
    return setting(
        0,
        "seed of the random numbers. It is combined with the stamp of the image, so that the same image always "
        "gives the same result",
        low=0,
        high=2**31 - 1,
    )


def check_window(window: int) -> None:
    if window % 2 == 0:
        raise ValueError(f"window must be odd, got {window}")


def check_depths(near: float, far: float) -> None:
    if near >= far:
        raise ValueError(f"near ({near} m) must be smaller than far ({far} m)")
