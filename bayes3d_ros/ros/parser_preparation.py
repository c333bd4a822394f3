# SPDX-License-Identifier: Apache-2.0

"""Parsers made of scene_parser's parameters: at once, or by the worker while the node goes on."""

import time
from collections.abc import Callable, Mapping
from typing import Any

from rclpy.lifecycle import Node

from bayes3d_ros.objects.model import Library, LibraryError, check_types
from bayes3d_ros.ros.depth_node import InferenceParts, library_in
from bayes3d_ros.ros.node_settings import SceneParserNodeSettings
from bayes3d_ros.ros.parser_bundle import LEAST_CAPACITY, MakeParser, make_bundle
from bayes3d_ros.ros.parser_in_use import ParserInUse
from bayes3d_ros.settings import ParserSettings

CANNOT_COMPILE = "cannot compile the parser"


class ParserPreparation:
    """Puts parsers into `in_use`. Of several requests the last one counts. Methods are the executor's to call.

    done(seconds): called on the executor when the worker has made a parser, or failed to: then `parts.refusal` says
    why.
    """

    def __init__(
        self,
        node: Node,
        parts: InferenceParts,
        in_use: ParserInUse,
        make_parser: MakeParser,
        done: Callable[[float], None],
    ) -> None:
        self._node, self._parts, self._in_use, self._make_parser, self._done = node, parts, in_use, make_parser, done
        self._libraries: tuple[Library, ...] = ()  # of the parser in use, and of the one that is being made
        self._capacity = LEAST_CAPACITY
        self._since: float | None = None
        self._requests = 0
        self._made = node.create_guard_condition(self._on_made)

    @property
    def seconds(self) -> float | None:
        """For how long the worker has had a parser to make; None where it has none."""
        return None if self._since is None else time.monotonic() - self._since

    @property
    def begun(self) -> bool:
        """Whether a parser is there or on its way."""
        return self._in_use.bundle is not None or self._since is not None

    def why_not(self, values: Mapping[str, Any]) -> str:
        """Why parameters may not have these values until the node is cleaned up; empty where they may."""
        most, types = values.get("max_objects"), values.get("types")
        if self.begun and isinstance(most, int) and most > self._capacity:
            return f"max_objects must be at most {self._capacity} until the node is cleaned up, got {most}"
        try:
            for library in self._libraries:
                check_types(types if isinstance(types, (list, tuple)) else (), library)
        except ValueError as error:
            return str(error)
        return ""

    def make(self) -> None:
        """Make a parser now; takes seconds to minutes. Raises ValueError or LibraryError where the parameters allow
        none, and whatever compiling raises."""
        library, settings = self._load()
        self._supersede()
        try:
            self._in_use.put(make_bundle(self._make_parser, library, settings, self._size(), self._capacity))
        finally:
            self._since = None
        self._libraries = (library,)

    def begin(self) -> str:
        """Have the worker make a parser of the parameters as they are now; what is wrong with them, or empty."""
        try:
            (library, settings), size = self._load(), self._size()
        except (ValueError, LibraryError) as error:
            if self._in_use.bundle is None:
                self._parts.refuse(str(error))
            return str(error)
        self._supersede()
        request, capacity = self._requests, self._capacity
        self._libraries = (*self._libraries_in_use(), library)
        self._node.get_logger().info(f"preparing a parser for {len(library.models)} object types")

        def job() -> None:
            if request != self._requests:
                return  # a later request is on its way
            try:
                bundle, refusal = make_bundle(self._make_parser, library, settings, size, capacity), ""
            except Exception as error:
                bundle, refusal = None, self._parts.failure(CANNOT_COMPILE, error)
            if request == self._requests:  # else nobody wants it any more
                if bundle is not None:
                    self._in_use.put(bundle)
                self._parts.refusal = refusal
                self._made.trigger()

        self._parts.worker.call(job)
        return ""

    def forget(self) -> None:
        """Forget the parser, and one that is on its way."""
        self._in_use.forget()
        self._libraries, self._capacity = (), LEAST_CAPACITY
        self._requests += 1
        self._since = None

    def _supersede(self) -> None:
        """A parser is made from now on; what the worker may be making is not wanted any more."""
        self._requests += 1
        self._since = time.monotonic()
        self._parts.refusal = ""

    def _on_made(self) -> None:
        if (seconds := self.seconds) is None:
            return  # forgotten meanwhile
        self._since = None
        self._libraries = self._libraries_in_use()
        self._done(seconds)

    def _libraries_in_use(self) -> tuple[Library, ...]:
        bundle = self._in_use.bundle
        return () if bundle is None else (bundle.parser.library,)

    def _load(self) -> tuple[Library, ParserSettings]:
        """The library and settings that the parameters name, which a parser may be made of. Raises ValueError,
        LibraryError."""
        folder = self._parts.settings.read(SceneParserNodeSettings).library
        settings = self._parts.settings.read(ParserSettings)
        library = library_in(folder)
        try:
            check_types(settings.types, library)
        except ValueError as error:
            raise ValueError(f"parameter {error} ({folder})") from None
        self._in_use.adjust(settings)
        self._capacity = max(self._capacity, settings.max_objects)
        return library, settings

    def _size(self) -> tuple[int, int]:
        settings = self._parts.settings.read(SceneParserNodeSettings)
        return settings.warm_up_width, settings.warm_up_height
