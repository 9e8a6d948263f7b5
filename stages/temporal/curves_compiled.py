"""Taking curves of local time out of long records, compiled: import only when one is reduced."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from magtiles.catalog.kernels.jit import compiled

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

NS_PER_DAY = 86_400_000_000_000


@compiled
def subtract(values: Floats, time: Ints, middles: Ints, curves: Floats, offset: float) -> None:
    """Subtract curves from values (element, time), in place.

    curves (element, month, minute) are periodic and linear along the minutes of the local day,
    which are those of the universal day and `offset` more, and linear in time between the
    `middles` of the months (month,), beyond them the nearest; times in ns, ascending.
    """
    elements, months, columns = curves.shape
    scale = columns / NS_PER_DAY
    after = 0
    for i in range(time.size):
        while after < months and middles[after] <= time[i]:
            after += 1
        before = max(after - 1, 0)
        later = min(after, months - 1)
        weight = 0.0
        if later > before:
            weight = (time[i] - middles[before]) / (middles[later] - middles[before])
        position = (time[i] % NS_PER_DAY) * scale + offset
        left = int(np.floor(position))
        along = position - left
        left %= columns
        right = left + 1 if left + 1 < columns else 0
        if along == 0.0:  # nothing is asked of the next, which may be NaN
            right = left
        for e in range(elements):
            one = curves[e, before, left] * (1.0 - along) + curves[e, before, right] * along
            other = curves[e, later, left] * (1.0 - along) + curves[e, later, right] * along
            values[e, i] -= one * (1.0 - weight) + other * weight
