"""Work on threads: in order, errors passed on."""

from __future__ import annotations

import pytest

from vflatten_ros.core.parallel import mapped


def test_results_come_in_order():
    assert list(mapped(lambda n: n * n, range(20))) == [n * n for n in range(20)]


def test_an_error_of_one_item_is_raised_in_its_turn():
    results = mapped(lambda n: 6 // n, (3, 2, 0))
    assert [next(results), next(results)] == [2, 3]
    with pytest.raises(ZeroDivisionError):
        next(results)
