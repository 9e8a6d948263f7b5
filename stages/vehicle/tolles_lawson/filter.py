"""Zero-phase band-pass and low-pass filters, and how far the ends of a run disturb them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.signal
from numpy.typing import NDArray

from magtiles.schemas.errors import ParameterError

Floats = NDArray[np.float64]

_ORDER = 4
_SETTLED = 0.01  # of an impulse's amplitude
_FREQUENCIES = 8192
_PADDING = 30  # samples continued beyond each end, mirrored in the end's value


@dataclass(frozen=True)
class Filter:
    """Butterworth of fourth order, run forward and backward: no delay, eighth order in effect.

    Attributes
    ----------
    low_hz, high_hz : limits of the band; None for none on that side. Both None pass all.
    """

    low_hz: float | None
    high_hz: float | None

    def apply(self, values: Floats, step_s: float) -> Floats:
        """Filter samples `step_s` apart along the first axis.

        Raises ParameterError where the band does not fit the sampling.
        """
        if self.low_hz is None and self.high_hz is None:
            return values
        padding = min(_PADDING, len(values) - 1)
        return np.asarray(
            scipy.signal.sosfiltfilt(self._sections(step_s), values, axis=0, padlen=padding)
        )

    def edge(self, step_s: float) -> int:
        """Samples at each end of a run until the response to an impulse falls below 1 %."""
        if self.low_hz is None and self.high_hz is None:
            return 0
        poles = np.concatenate([np.roots(section[3:]) for section in self._sections(step_s)])
        return int(np.ceil(np.log(_SETTLED) / np.log(np.abs(poles).max())))

    def noise_gain(self, step_s: float) -> float:
        """Share of white noise's variance that passes."""
        if self.low_hz is None and self.high_hz is None:
            return 1.0
        _, response = scipy.signal.sosfreqz(self._sections(step_s), worN=_FREQUENCIES)
        return float(np.mean(np.abs(response) ** 4))  # forward and backward

    def _sections(self, step_s: float) -> Floats:
        rate = 1.0 / step_s
        limits = [f for f in (self.low_hz, self.high_hz) if f is not None]
        if max(limits) >= 0.5 * rate:
            raise ParameterError(
                f"a band up to {max(limits):g} Hz does not fit samples {step_s:g} s apart",
                where="band",
                expected=f"less than {0.5 * rate:g} Hz, half the sampling rate",
                remedy="lower the band, or bring data sampled more often",
            )
        kind = "lowpass" if self.low_hz is None else "bandpass"
        sections = scipy.signal.butter(
            _ORDER, limits if kind == "bandpass" else limits[0], kind, fs=rate, output="sos"
        )
        return np.asarray(sections)
