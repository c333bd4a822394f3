# SPDX-License-Identifier: Apache-2.0

"""Settings of the algorithms. Those of nodes alone are in `ros/node_settings.py`."""

from bayes3d_ros.settings.declaring import RETIRED, UnfinishedSettings, element_type, retirement, setting, validate
from bayes3d_ros.settings.learner import LearnerSettings
from bayes3d_ros.settings.parser import PER_FRAME, ParserSettings
from bayes3d_ros.settings.tracker import TrackerSettings

__all__ = [
    "PER_FRAME",
    "RETIRED",
    "LearnerSettings",
    "ParserSettings",
    "TrackerSettings",
    "UnfinishedSettings",
    "element_type",
    "retirement",
    "setting",
    "validate",
]
