"""Numbers in fixed columns of equally long lines, read in bulk.

A year of one-minute values is 37 MB of text. Parsing it line by line takes seconds; here the
bytes of each column are decoded for many lines at once, and a number is the whole number of its
digits divided by a power of ten: the same double that parsing the text gives, since both round
one exact quotient.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Bytes = NDArray[np.uint8]

_ZERO, _BLANK, _MINUS, _POINT = (np.uint8(ord(c)) for c in "0 -.")


def whole_numbers(columns: Bytes) -> tuple[NDArray[np.int32], bool]:
    """Unsigned whole numbers from (digits, rows) characters, and whether all are digits."""
    digits = columns - _ZERO
    value = np.zeros(columns.shape[1], np.int32)
    for digit in digits:
        value *= 10
        value += digit
    return value, bool((digits < 10).all())


def fixed_point(columns: Bytes, point: int) -> tuple[NDArray[np.float64], bool]:
    """Signed decimals from (width, rows) characters with the decimal point in row `point`.

    Blanks may only precede the sign, and the sign only the digits. The second value says whether
    every number is of that form; where it is False the values mean nothing.
    """
    digits = columns - _ZERO
    is_digit = digits < 10
    begun = np.zeros(columns.shape[1], np.bool_)
    negative = np.zeros_like(begun)
    value = np.zeros(columns.shape[1], np.int32)
    good = True
    for row in range(point):
        minus = columns[row] == _MINUS
        fits = is_digit[row] | (~begun & (minus | (columns[row] == _BLANK)))
        good = good and bool(fits.all())
        negative |= minus
        begun |= is_digit[row] | minus
        value *= 10
        value += np.where(is_digit[row], digits[row], np.uint8(0))
    good = good and bool((columns[point] == _POINT).all() and is_digit[point + 1 :].all())
    for digit in digits[point + 1 :]:
        value *= 10
        value += digit
    np.negative(value, out=value, where=negative)
    return value / 10.0 ** (len(columns) - point - 1), good and bool(is_digit[point - 1].all())
