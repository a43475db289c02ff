"""Values that are made when they are asked for, or beside other work."""

from collections.abc import Callable
from concurrent.futures import Executor, Future
from typing import Generic, TypeVar

T = TypeVar("T")


class Deferred(Generic[T]):
    """A value made once: at once by an executor if there is one, else by who needs it first; the same by both."""

    def __init__(self, make: Callable[[], T], executor: Executor | None = None) -> None:
        self._make = make
        self._coming: Future[T] | None = None if executor is None else executor.submit(make)
        self._made: list[T] = []

    def begin(self, executor: Executor) -> None:
        """Makes the value beside what goes on."""
        self._coming = executor.submit(self._make)

    def cancel(self) -> None:
        """Does not begin to make it any more, unless it is asked for."""
        if self._coming is not None and self._coming.cancel():
            self._coming = None

    def get(self) -> T:
        """The value; waits for it where it has been begun."""
        if not self._made:
            self._made.append(self._make() if self._coming is None else self._coming.result())
        return self._made[0]
