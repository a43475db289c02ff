"""The reason that findings give for a failed run."""

from sigmaslam.checks.finding import Finding, explain, has_errors, wrong

SHIFT = Finding("rows", "error", "rows are off", 3.0)
DARK = Finding("exposure", "warning", "images are dark", 0.6)
LENGTH = Finding("baseline", "warning", "baseline is long", 54.0)
GOOD = Finding("eyes", "ok", "left is left", 1.0)
UNSEEN = Finding("synchronisation", "unknown", "the camera does not move")


def test_causes_come_before_their_consequences():
    assert wrong([GOOD, SHIFT, LENGTH, UNSEEN, DARK]) == [DARK, SHIFT, LENGTH]


def test_the_reason_is_the_errors_and_what_may_have_caused_them():
    assert explain([GOOD, SHIFT, LENGTH, DARK]) == "images are dark\nrows are off"


def test_warnings_are_the_reason_where_there_is_no_error():
    assert explain([LENGTH, GOOD]) == "baseline is long"
    assert not has_errors([LENGTH, GOOD])
    assert has_errors([LENGTH, SHIFT])


def test_without_a_fault_there_is_no_reason():
    assert explain([GOOD, UNSEEN]) == explain([]) == ""
