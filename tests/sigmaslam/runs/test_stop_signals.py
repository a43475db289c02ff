"""Signals that end a run, once."""

import os
import signal
import threading
from collections.abc import Iterator

import pytest

from sigmaslam.runs.stop_signals import Stopped, StopSignals

NUMBERS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)


@pytest.fixture(autouse=True)
def handlers() -> Iterator[None]:
    """Handlers are the default ones, also where the parent ignores a signal, and as before after a test."""
    before = [signal.getsignal(number) for number in NUMBERS]
    for number in NUMBERS:
        signal.signal(number, signal.SIG_DFL)
    yield
    for number, handler in zip(NUMBERS, before, strict=True):
        signal.signal(number, handler)


def send(number: signal.Signals) -> None:
    os.kill(os.getpid(), number)
    signal.getsignal(number)  # Python runs handlers between instructions


@pytest.mark.parametrize(("number", "code"), list(zip(NUMBERS, (130, 143, 129), strict=True)))
def test_the_first_signal_is_raised_and_later_ones_are_not(number: signal.Signals, code: int):
    with StopSignals() as signals:
        with pytest.raises(Stopped) as stopped:
            send(number)
        for each in NUMBERS:
            send(each)
        assert signals.received == number
    assert stopped.value.exit_code == code
    # The process is about to end; nothing must end it otherwise.
    assert [signal.getsignal(each) for each in NUMBERS] == [signal.SIG_IGN] * len(NUMBERS)


def test_handlers_are_as_before_where_no_signal_came():
    before = [signal.getsignal(each) for each in NUMBERS]
    with StopSignals():
        pass
    assert [signal.getsignal(each) for each in NUMBERS] == before


def test_no_signal_disturbs_what_is_held():
    with StopSignals() as signals:
        signals.hold()
        for number in NUMBERS:
            send(number)
        assert signals.received is None


def test_a_signal_that_the_process_ignores_stays_ignored():
    """As SIGHUP under nohup."""
    signal.signal(signal.SIGHUP, signal.SIG_IGN)
    with StopSignals() as signals:
        send(signal.SIGHUP)
        assert signals.received is None
        with pytest.raises(Stopped):
            send(signal.SIGTERM)
    assert signal.getsignal(signal.SIGHUP) == signal.SIG_IGN


def test_other_threads_handle_no_signals():
    before = signal.getsignal(signal.SIGTERM)
    seen = []

    def work() -> None:
        with StopSignals():
            seen.append(signal.getsignal(signal.SIGTERM))

    thread = threading.Thread(target=work)
    thread.start()
    thread.join()
    assert seen == [before]
