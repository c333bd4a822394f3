# SPDX-License-Identifier: Apache-2.0

"""Parsers made of scene_parser's parameters: at once, or by the worker while the node goes on."""

import threading
import time
from collections.abc import Callable, Mapping
from dataclasses import fields
from typing import Any, NamedTuple

from rclpy.lifecycle import Node

from bayes3d_ros.objects.model import Library, LibraryError, check_types
from bayes3d_ros.ros.depth_node import InferenceParts, library_in
from bayes3d_ros.ros.node_settings import SceneParserNodeSettings
from bayes3d_ros.ros.parser_bundle import LEAST_CAPACITY, MakeParser, make_bundle
from bayes3d_ros.ros.parser_in_use import ParserInUse
from bayes3d_ros.settings import PER_FRAME, ParserSettings

CANNOT_COMPILE = "cannot compile the parser"


class _Made(NamedTuple):
    """What became of a request: the seconds that it took, and why there is no parser (empty: there is one)."""

    request: int
    seconds: float
    refusal: str


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
        self._wanted: ParserSettings | None = None  # of the newest parser; None where it could not be made
        self._capacity = LEAST_CAPACITY
        self._since: float | None = None
        self._lock = threading.Lock()  # for the next two: whether a request is still wanted, and what came of it
        self._requests = 0
        self._newest: _Made | None = None  # not told yet
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
        settings = self._parts.settings.read(ParserSettings)
        library = self._load(settings)
        self._take_over(settings)
        self._supersede(settings)
        try:
            self._in_use.put(make_bundle(self._make_parser, library, settings, self._size(), self._capacity))
        except BaseException:
            self._wanted = None
            raise
        finally:
            self._since = None
        self._libraries = (library,)

    def begin(self) -> str:
        """Have the worker make a parser of the parameters and the library's files as they are now; what is wrong with
        them, or empty."""
        return self._begin(reload=True)

    def adapt(self) -> str:
        """Have the worker make a parser of the parameters as they are now, where the newest parser has other ones, with
        the library that it has; what is wrong with them, or empty."""
        return self._begin(reload=False)

    def _begin(self, *, reload: bool) -> str:
        try:
            settings, size = self._parts.settings.read(ParserSettings), self._size()
            library = self._load(settings) if reload or not self._libraries else self._libraries[-1]
        except (ValueError, LibraryError) as error:
            if self._in_use.bundle is None:
                self._parts.refuse(str(error))
            return str(error)
        self._take_over(settings)
        if not reload and self._wanted is not None and _compiled_alike(settings, self._wanted):
            self._parts.refusal = ""  # of values that are set back
            return ""
        self._supersede(settings)
        request, capacity = self._requests, self._capacity
        self._libraries = (*self._libraries_in_use(), library)
        self._node.get_logger().info(f"preparing a parser for {len(library.models)} object types")

        def job() -> None:
            if request != self._requests:
                return  # a later request is on its way
            began = time.monotonic()
            try:
                bundle, refusal = make_bundle(self._make_parser, library, settings, size, capacity), ""
            except Exception as error:
                bundle, refusal = None, self._parts.failure(CANNOT_COMPILE, error)
            with self._lock:
                if request != self._requests:
                    return  # nobody wants it any more
                if bundle is not None:
                    self._in_use.put(bundle)
                self._newest = _Made(request, time.monotonic() - began, refusal)
            self._made.trigger()

        self._parts.worker.call(job)
        return ""

    def forget(self) -> None:
        """Forget the parser, and one that is on its way."""
        with self._lock:
            self._requests += 1
            self._newest = None
            self._in_use.forget()
        self._libraries, self._capacity, self._wanted = (), LEAST_CAPACITY, None
        self._since = None

    def _supersede(self, settings: ParserSettings) -> None:
        """A parser is made from now on; what the worker may be making is not wanted any more."""
        with self._lock:
            self._requests += 1
        self._parts.refusal = ""
        self._wanted = settings
        self._since = time.monotonic()

    def _on_made(self) -> None:
        with self._lock:
            made, self._newest = self._newest, None
            newest = made is not None and made.request == self._requests
        if made is None:
            return  # forgotten meanwhile
        if newest:
            self._since = None
            self._libraries = self._libraries_in_use()
            self._parts.refusal = made.refusal
            if made.refusal:
                self._wanted = None
        elif made.refusal:
            return
        else:  # it serves until the next one is made
            self._libraries = (*self._libraries_in_use(), self._libraries[-1])
        self._done(made.seconds)

    def _libraries_in_use(self) -> tuple[Library, ...]:
        bundle = self._in_use.bundle
        return () if bundle is None else (bundle.parser.library,)

    def _load(self, settings: ParserSettings) -> Library:
        """The library that the parameters name, which a parser of these settings may be made of. Raises ValueError,
        LibraryError."""
        folder = self._parts.settings.read(SceneParserNodeSettings).library
        library = library_in(folder)
        try:
            check_types(settings.types, library)
        except ValueError as error:
            raise ValueError(f"parameter {error} ({folder})") from None
        return library

    def _take_over(self, settings: ParserSettings) -> None:
        """What holds from one frame to the next, for the parser in use and for those to come."""
        self._in_use.adjust(settings)
        self._capacity = max(self._capacity, settings.max_objects)

    def _size(self) -> tuple[int, int]:
        settings = self._parts.settings.read(SceneParserNodeSettings)
        return settings.warm_up_width, settings.warm_up_height


def _compiled_alike(one: ParserSettings, other: ParserSettings) -> bool:
    """Whether a parser of one serves for the other: they differ in PER_FRAME settings alone."""
    compiled = [field.name for field in fields(ParserSettings) if field.name not in PER_FRAME]
    return all(getattr(one, name) == getattr(other, name) for name in compiled)
