# SPDX-License-Identifier: Apache-2.0

"""Parsers that are asked for one after the other: which one serves, what is told of it, and when files are read."""

from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import pytest
from fake_scene_parser import FakeParser

from bayes3d_ros.objects.model import Library
from bayes3d_ros.ros import parser_preparation
from bayes3d_ros.ros.node_settings import SceneParserNodeSettings
from bayes3d_ros.ros.parser_in_use import ParserInUse
from bayes3d_ros.ros.parser_preparation import ParserPreparation
from bayes3d_ros.settings import ParserSettings


class Bench:
    """A preparation whose worker's jobs and guard condition run when a test says so; `read` counts library loads."""

    def __init__(self, library: Library, monkeypatch: pytest.MonkeyPatch) -> None:
        self.jobs: list[Callable[[], None]] = []
        self.told: list[tuple[str, ...]] = []  # names of the library in use at every `done`
        self.read, self.library, self.parameters = 0, library, ParserSettings()
        self.triggered = 0
        self.in_use = ParserInUse()
        self.parts: Any = SimpleNamespace(
            settings=SimpleNamespace(read=self._settings), worker=SimpleNamespace(call=self.jobs.append), refusal="",
            refuse=lambda why: None, failure=lambda what, error: f"{what}: {error}",
        )  # fmt: skip
        guard = SimpleNamespace(trigger=self._trigger)
        log = SimpleNamespace(info=lambda text: None)
        node: Any = SimpleNamespace(create_guard_condition=self._keep(guard), get_logger=lambda: log)
        self.on_load: Callable[[], None] = lambda: None
        monkeypatch.setattr(parser_preparation, "library_in", self._load)
        self.preparation = ParserPreparation(node, self.parts, self.in_use, FakeParser, self._done)

    def work(self) -> None:
        """Run the worker's jobs."""
        while self.jobs:
            self.jobs.pop(0)()

    def spin(self) -> None:
        """Run what the guard condition was triggered for; rclpy joins triggers that come before it looks."""
        if self.triggered:
            self.triggered = 0
            self.callback()

    def _keep(self, guard: Any) -> Callable[[Callable[[], None]], Any]:
        def create(callback: Callable[[], None]) -> Any:
            self.callback = callback
            return guard

        return create

    def _trigger(self) -> None:
        self.triggered += 1

    def _settings(self, kind: type) -> Any:
        return self.parameters if kind is ParserSettings else SceneParserNodeSettings(warm_up_width=0)

    def _load(self, folder: str) -> Library:
        self.read += 1
        self.on_load()
        return self.library

    def _done(self, seconds: float) -> None:
        assert self.in_use.bundle is not None or self.parts.refusal
        self.told.append(() if self.in_use.bundle is None else self.in_use.bundle.parser.library.names)


@pytest.fixture
def bench(library: Library, monkeypatch: pytest.MonkeyPatch) -> Bench:
    made = Bench(library, monkeypatch)
    assert not made.preparation.begin()
    made.work()
    made.spin()
    assert made.told == [library.names] and made.preparation.seconds is None
    return made


def smaller(library: Library) -> Library:
    return Library(library.models[:1])


def test_a_parser_that_is_ready_while_the_next_library_is_read_is_told_and_so_is_the_next(bench: Bench) -> None:
    """A reader of ~/posterior takes types for those of ~/library: each library that serves has to be told."""
    large = bench.library
    assert not bench.preparation.begin()
    bench.library, bench.on_load = smaller(large), bench.work  # the worker ends in the middle of the next call
    assert not bench.preparation.begin()
    bench.spin()
    assert bench.told[1:] == [large.names]
    assert bench.preparation.seconds is not None  # another one is on its way
    bench.work()
    bench.spin()
    assert bench.told[2:] == [large.names[:1]] and bench.preparation.seconds is None
    assert "it holds brick" in bench.preparation.why_not({"types": ["cube"]})


def test_what_is_forgotten_while_it_is_made_neither_serves_nor_is_told(bench: Bench) -> None:
    assert not bench.preparation.begin()
    bench.preparation.forget()
    bench.work()
    bench.spin()
    assert bench.in_use.bundle is None and len(bench.told) == 1
    assert not bench.preparation.begin()
    bench.work()
    bench.preparation.forget()
    bench.spin()
    assert bench.in_use.bundle is None and len(bench.told) == 1


def test_a_parameter_does_not_read_the_library(bench: Bench) -> None:
    """Files that are being reviewed must not go into service because somebody sets a number."""
    read = bench.read
    bench.parameters = ParserSettings(particles=64)
    assert not bench.preparation.adapt()
    bench.work()
    bench.spin()
    assert bench.read == read and len(bench.told) == 2
    bundle = bench.in_use.bundle
    assert bundle is not None and bundle.parser.settings.particles == 64


def test_a_value_that_a_parameter_has_changes_nothing_and_takes_a_refusal_back(bench: Bench) -> None:
    bench.parts.refusal = "fixed_objects does not fit max_objects"
    assert not bench.preparation.adapt()
    assert not bench.jobs and bench.parts.refusal == ""
    bench.parameters = ParserSettings(max_objects=3)  # holds from the next image on
    assert not bench.preparation.adapt()
    assert not bench.jobs
    bundle = bench.in_use.bundle
    assert bundle is not None and bundle.parser.settings.max_objects == 3


def test_what_holds_from_one_image_to_the_next_may_have_changed_before(bench: Bench) -> None:
    """Settings of before must not be mixed with those of now: they need not fit each other."""
    bench.parameters = ParserSettings(max_objects=3)
    assert not bench.preparation.begin()
    bench.work()
    bench.spin()
    bench.parameters = ParserSettings(max_objects=8, fixed_objects=5)
    assert not bench.preparation.adapt()
    bench.work()
    bench.spin()
    bundle = bench.in_use.bundle
    assert bundle is not None and bundle.parser.settings == bench.parameters


def test_a_parser_that_could_not_be_made_is_tried_again(bench: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(*arguments: object) -> None:
        raise RuntimeError("out of memory")

    with monkeypatch.context() as broken:
        broken.setattr(parser_preparation, "make_bundle", fail)
        bench.parameters = ParserSettings(particles=64)
        assert not bench.preparation.adapt()
        bench.work()
        bench.spin()
    assert bench.parts.refusal == "cannot compile the parser: out of memory"
    assert not bench.preparation.adapt()
    bench.work()
    bench.spin()
    bundle = bench.in_use.bundle
    assert bench.parts.refusal == "" and bundle is not None and bundle.parser.settings.particles == 64
