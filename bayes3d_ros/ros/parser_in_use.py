# SPDX-License-Identifier: Apache-2.0

"""The parser that serves a node's frames, and settings that it takes from one frame to the next."""

import threading
from dataclasses import replace

from bayes3d_ros.ros.parser_bundle import ParserBundle
from bayes3d_ros.settings import PER_FRAME, ParserSettings


class ParserInUse:
    """Holds a parser bundle for the worker, which reads it once a frame.

    The executor changes settings, the worker puts new parsers: `types`, `region` and `max_objects` reach the parser
    whichever comes later. Methods may be called from any thread.
    """

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._bundle: ParserBundle | None = None
        self._settings: ParserSettings | None = None

    @property
    def bundle(self) -> ParserBundle | None:
        """The bundle as it is now; none where nothing is compiled."""
        return self._bundle

    def put(self, bundle: ParserBundle) -> None:
        """Serve frames with another parser from now on."""
        with self._lock:
            self._bundle = self._adjusted(bundle)

    def forget(self) -> None:
        """Serve none."""
        with self._lock:
            self._bundle = None

    def adjust(self, settings: ParserSettings) -> None:
        """Take over the PER_FRAME settings of these, for this parser and for those to come."""
        with self._lock:
            self._settings = settings
            self._bundle = self._bundle and self._adjusted(self._bundle)

    def _adjusted(self, bundle: ParserBundle) -> ParserBundle:
        if self._settings is None:
            return bundle
        values = {name: getattr(self._settings, name) for name in PER_FRAME}
        try:
            return bundle._replace(parser=bundle.parser.changed(replace(bundle.parser.settings, **values)))
        except ValueError:  # they fit other settings, for which a parser is on its way
            return bundle
