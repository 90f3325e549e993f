"""The line that names the stage of a command is there from the begin of the stage."""

from __future__ import annotations

import io
import threading

import pytest

from mitsuba_irrcache.core import stage_display
from mitsuba_irrcache.core.stage_display import StageDisplay

CLEAR = "\r\x1b[K"


class Stream(io.StringIO):
    """A stream that may be a terminal, and tells when a text was written to it."""

    def __init__(self, is_terminal: bool) -> None:
        super().__init__()
        self._is_terminal = is_terminal
        self.awaited, self.found = "\0", threading.Event()

    def isatty(self) -> bool:
        return self._is_terminal

    def write(self, text: str) -> int:
        if self.awaited in text:
            self.found.set()
        return super().write(text)

    def wait_for(self, text: str) -> bool:
        self.awaited = text
        return text in self.getvalue() or self.found.wait(timeout=60)


def test_stage_is_named_before_it_begins_and_cleared_after_it():
    stream = Stream(is_terminal=True)
    with StageDisplay(stream).stage("loading"):
        assert stream.getvalue() == f"{CLEAR}loading  0 s"
    assert stream.getvalue().endswith(CLEAR)


def test_line_is_updated_while_the_stage_does_not_return(monkeypatch):
    monkeypatch.setattr(stage_display, "_INTERVAL", 0.01)
    stream = Stream(is_terminal=True)
    display = StageDisplay(stream)
    with display.stage("compiling"):
        display.advance("cache", 3, 8)
        assert stream.wait_for("cache  38%")


def test_output_is_not_mixed_with_the_line(capsys):
    stream = Stream(is_terminal=True)
    display = StageDisplay(stream)
    with display.stage("cache"):
        display.print("64 samples")
        assert stream.getvalue().endswith(CLEAR)
    assert capsys.readouterr().out == "64 samples\n"


@pytest.mark.parametrize("is_long", [False, True])
def test_log_names_long_stages_once(monkeypatch, is_long):
    monkeypatch.setattr(stage_display, "_INTERVAL", 0.01)
    monkeypatch.setattr(stage_display, "_LONG", 0.0 if is_long else 1e9)
    stream = Stream(is_terminal=False)
    with StageDisplay(stream).stage("rendering"):
        assert not is_long or stream.wait_for("rendering")
    assert stream.getvalue() == ("rendering\n" if is_long else "")


def test_line_is_cleared_after_an_error():
    stream = Stream(is_terminal=True)
    with pytest.raises(ValueError, match="bad"), StageDisplay(stream).stage("reading"):
        raise ValueError("bad")
    assert stream.getvalue().endswith(CLEAR)
