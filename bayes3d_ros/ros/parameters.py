# SPDX-License-Identifier: Apache-2.0

"""ROS parameters, their descriptors and the yaml files, all derived from the dataclasses of settings."""

import difflib
import math
import re
import sys
import textwrap
from dataclasses import MISSING, Field, fields
from typing import Any, TypeVar

import yaml
from rcl_interfaces.msg import FloatingPointRange, IntegerRange, ParameterDescriptor, SetParametersResult
from rclpy.exceptions import InvalidParameterException, InvalidParameterTypeException, InvalidParameterValueException
from rclpy.node import Node
from rclpy.parameter import Parameter

from bayes3d_ros.ros.node_settings import NODE_SETTINGS
from bayes3d_ros.settings import RETIRED, UnfinishedSettings, element_type, retirement

Settings = TypeVar("Settings")
# What rclpy, or a part of it, may declare later, or not in every version.
_STANDARD_PARAMETERS = {"use_sim_time", "start_type_description_service"}
_STANDARD_PREFIXES = ("qos_overrides.",)


class SettingsParameters:
    """Declares the fields of settings dataclasses as a node's parameters, keeps them valid and reads them back.

    A value from a file or the command line that is wrong does not stop the node: the default stands in for it and
    `problems` says of each what is wrong, until that parameter is set again. So it does of a retired name, until the
    parameter that took its place is set. A value for a name that no parameter has is a warning in the log.
    """

    def __init__(self, node: Node, kinds: tuple[type, ...]) -> None:
        self._node, self._kinds = node, kinds
        self.problems: dict[str, str] = {}
        for kind in kinds:
            for field in fields(kind):
                self._declare(field)
        for kind in kinds:
            self._replace_invalid(kind)
        self._check_names()

    def read(self, kind: type[Settings]) -> Settings:
        """The settings as they are now. ValueError with one line naming the parameter."""
        if self.problems:
            raise ValueError("; ".join(self.problems.values()))
        try:
            return self._build(kind, {})
        except ValueError as error:
            raise ValueError(f"parameter {error}") from None

    def in_use(self, kind: type[Settings]) -> Settings:
        """The settings as they are now, with defaults in the place of wrong values."""
        return self._build(kind, {})

    def check(self, parameters: list[Parameter]) -> SetParametersResult:
        """Whether these values may be set: for add_on_set_parameters_callback. A value that waits for another one may;
        `read` refuses it until the other one is set."""
        changed = {p.name: p.value for p in parameters}
        for kind in self._kinds:
            try:
                self._build(kind, changed)
            except UnfinishedSettings:
                continue
            except ValueError as error:
                return SetParametersResult(successful=False, reason=str(error))
        for name in changed:
            self.problems.pop(name, None)
        return SetParametersResult(successful=True)

    def _declare(self, field: Field) -> None:
        descriptor, default = describe(field), parameter_value(field)
        try:
            self._node.declare_parameter(field.name, default, descriptor)
            _typed(field, self._node.get_parameter(field.name).value)
        except (InvalidParameterTypeException, InvalidParameterValueException, InvalidParameterException) as error:
            reason = str(error).splitlines()[0].removesuffix(f": {field.name}")
            self.problems[field.name] = f"parameter {field.name}: {reason}"
        except ValueError as error:
            self.problems[field.name] = f"parameter {error}"
        if field.name in self.problems:
            self._use_default(field)

    def _replace_invalid(self, kind: type) -> None:
        """Put defaults where the dataclass refuses a value, one after the other. Errors begin with the setting's name;
        where that has its default already, another one that the error names is wrong (near and far)."""
        named = {field.name: field for field in fields(kind)}  # type: ignore[arg-type]
        while True:
            try:
                self._build(kind, {})
                return
            except UnfinishedSettings:
                return  # `read` refuses them until the others are set
            except ValueError as error:
                words = re.findall(r"\w+", str(error))
                wrong = next((named[word] for word in words if word in named and self._differs(named[word])), None)
                if wrong is None:
                    raise
                self.problems[wrong.name] = f"parameter {error}"
                self._use_default(wrong)

    def _differs(self, field: Field) -> bool:
        """Whether a parameter has another value than its default."""
        value = self._node.get_parameter(field.name).value
        return repr(_typed(field, value)) != repr(field.default)  # as NaN is not equal to NaN

    def _check_names(self) -> None:
        """Look at the names that files and the command line give values for: rclpy drops those it does not know."""
        known = {field.name for kind in self._kinds for field in fields(kind)}
        for name in sorted(self._node._parameter_overrides):
            if told := retirement(name, known):
                new = RETIRED[name]
                earlier = [self.problems[new]] if new in self.problems else []
                self.problems[new] = "; ".join([*earlier, f"parameter {name}: {told}"])
            elif not self._is_parameter(name):
                near = difflib.get_close_matches(name.rpartition(".")[2], known, n=1)
                hint = f"; the nearest name is {near[0]}" if near else ""
                log = self._node.get_logger()
                log.warning(f"parameter {name}: {self._node.get_name()} has none of this name, it is not used{hint}")

    def _is_parameter(self, name: str) -> bool:
        standard = name in _STANDARD_PARAMETERS or name.startswith(_STANDARD_PREFIXES)
        return standard or self._node.has_parameter(name)

    def _use_default(self, field: Field) -> None:
        if self._node.has_parameter(field.name):
            self._node.undeclare_parameter(field.name)
        self._node.declare_parameter(field.name, parameter_value(field), describe(field), ignore_override=True)

    def _build(self, kind: type[Settings], changed: dict[str, Any]) -> Settings:
        values = {}
        for field in fields(kind):  # type: ignore[arg-type]
            value = changed[field.name] if field.name in changed else self._node.get_parameter(field.name).value
            values[field.name] = _typed(field, value)
        return kind(**values)


def parameter_value(field: Field) -> Any:
    """A field's default as a parameter's value. An empty pose is an empty list of doubles."""
    if field.default is MISSING:
        raise TypeError(f"setting {field.name} has no default")
    return list(field.default) if isinstance(field.default, tuple) else field.default


def describe(field: Field) -> ParameterDescriptor:
    """The descriptor of a setting: description with its unit, range, and the type where it is not a number."""
    meta = field.metadata
    unit = f" [{meta['unit']}]" if meta["unit"] else ""
    descriptor = ParameterDescriptor(name=field.name, description=meta["description"] + unit)
    # Numbers and lists are typed here and not by rclpy, so that `far: 3` does for 3.0 and `[]` for no pose.
    descriptor.dynamic_typing = isinstance(field.default, (float, tuple))
    descriptor.read_only = field.name == "autostart"
    if meta["choices"]:
        descriptor.additional_constraints = "one of: " + ", ".join(meta["choices"])
    low, high = meta["low"], meta["high"]
    if low is None and high is None:
        return descriptor
    if isinstance(field.default, int):
        bounds = (-(2**63) if low is None else low, 2**63 - 1 if high is None else high)
        descriptor.integer_range = [IntegerRange(from_value=int(bounds[0]), to_value=int(bounds[1]))]
    else:
        limit = sys.float_info.max
        bounds = (-limit if low is None else low, limit if high is None else high)
        descriptor.floating_point_range = [FloatingPointRange(from_value=float(bounds[0]), to_value=float(bounds[1]))]
    return descriptor


def _typed(field: Field, value: Any) -> Any:
    """A parameter's value as the setting's type. ValueError naming the setting."""
    expected = type(field.default)
    number = isinstance(value, (int, float)) and not isinstance(value, bool)
    if expected is float and number:
        may_be_unset = isinstance(field.default, float) and math.isnan(field.default)
        if not math.isfinite(value) and not (may_be_unset and math.isnan(value)):
            raise ValueError(f"{field.name} must be finite, got {value}")
        return float(value)
    if expected is tuple:
        return _typed_list(field, [] if value is None else value)
    if type(value) is not expected:
        raise ValueError(f"{field.name} must be of type {expected.__name__}, got {value!r}")
    return value


def _typed_list(field: Field, values: Any) -> tuple:
    """A list's elements as the setting's. ValueError naming the setting."""
    names = element_type(field) is str
    wrong = ValueError(f"{field.name} must be a list of {'names' if names else 'numbers'}, got {values!r}")
    if isinstance(values, (str, bytes)) or not hasattr(values, "__iter__"):
        raise wrong
    if names:
        if not all(isinstance(v, str) for v in values):
            raise wrong
        return tuple(values)
    try:
        return tuple(float(v) for v in values)
    except (TypeError, ValueError):
        raise wrong from None


def yaml_text(node_name: str, kinds: tuple[type, ...]) -> str:
    """A parameter file with every setting at its default, its description, unit, range and choices above it."""
    lines = [
        f"# Parameters of {node_name} and their defaults. Written by `python -m bayes3d_ros.ros.parameters NODE`;",
        "# a test compares this file with the settings' dataclasses.",
        "/**:  # whatever the node is called",
        "  ros__parameters:",
    ]
    for kind in kinds:
        for field in fields(kind):
            comment = f"{field.metadata['description']}{_range_text(field)}"
            lines += [f"    # {line}" for line in textwrap.wrap(comment, 110)]
            value = parameter_value(field)
            lines.append(f"    {field.name}: {yaml.safe_dump(value, default_flow_style=True).splitlines()[0]}")
    return "\n".join(lines) + "\n"


def _range_text(field: Field) -> str:
    meta, parts = field.metadata, []
    if meta["unit"]:
        parts.append(meta["unit"])
    if meta["choices"]:
        parts.append(" | ".join(meta["choices"]))
    if meta["low"] is not None:
        parts.append(f">= {meta['low']}")
    if meta["high"] is not None:
        parts.append(f"<= {meta['high']}")
    return f" ({', '.join(parts)})" if parts else ""


if __name__ == "__main__":
    sys.stdout.write(yaml_text(sys.argv[1], NODE_SETTINGS[sys.argv[1]]))
