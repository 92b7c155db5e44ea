"""Items that a thread makes before they are asked for."""

from __future__ import annotations

import threading
from collections.abc import Generator

import pytest

from uni4d_fg.optim.threads import made_ahead


class Numbers:
    """Counts to ten, and keeps what was made and where."""

    def __init__(self, fails_at: int | None = None) -> None:
        self.made: list[int] = []
        self.threads: set[int] = set()
        self.is_closed = False
        self.fails_at = fails_at

    def items(self) -> Generator[int, None, None]:
        try:
            for number in range(10):
                if number == self.fails_at:
                    raise ValueError("five is too much")
                self.made.append(number)
                self.threads.add(threading.get_ident())
                yield number
        finally:
            self.is_closed = True


@pytest.mark.parametrize("threads", [1, 2])
def test_items_come_in_order(threads: int) -> None:
    numbers = Numbers()
    assert list(made_ahead(numbers.items(), threads)) == list(range(10))
    assert numbers.is_closed
    assert (threading.get_ident() in numbers.threads) == (threads == 1)


def test_no_more_than_asked_for_are_made_ahead() -> None:
    numbers = Numbers()
    items = made_ahead(numbers.items(), 2, ahead=2)
    assert next(items) == 0
    items.close()  # type: ignore[attr-defined]
    assert len(numbers.made) <= 3
    assert numbers.is_closed


@pytest.mark.parametrize("threads", [1, 2])
def test_what_goes_wrong_is_raised_where_it_would_be(threads: int) -> None:
    items = made_ahead(Numbers(fails_at=5).items(), threads)
    assert [next(items) for _ in range(5)] == [0, 1, 2, 3, 4]
    with pytest.raises(ValueError, match="five is too much"):
        next(items)
