"""What the temporal model of a release says at positions and dates, as plain values."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from magtiles.pipeline.output import print_table

if TYPE_CHECKING:
    from magtiles.catalog.releases.reader import Release
    from magtiles.catalog.releases.temporal import TemporalModel

Place = tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.str_]]
_ELEMENTS = ("north", "east", "down", "total")


def temporal_answers(
    release: Release, positions: NDArray[np.float64], dates: Sequence[str], kp: float | None
) -> list[dict[str, Any] | None]:
    """One answer for each position (n, 3): latitude, longitude (deg), height; None for no model.

    Keys: `baseline`, `standard_error`, `days_outside`, `sigma`, `tau`, `tau_unidentified`,
    `classes`, None where the model has no such part; `weights` by observatory; `dip_distance`
    in degrees; `polar`.
    """
    count = len(positions)
    if release.manifest.temporal is None or not dates:
        return [None] * count
    model = release.temporal
    place = positions[:, 0], positions[:, 1], np.broadcast_to(np.array(dates), count)
    answers: list[dict[str, Any]] = [{} for _ in range(count)]
    _add_baseline(answers, model, place)
    _add_fogm(answers, model, place, kp)
    return list(answers)


def _add_baseline(answers: list[dict[str, Any]], model: TemporalModel, place: Place) -> None:
    if not model.months.size:
        for answer in answers:
            answer |= dict.fromkeys(("baseline", "standard_error", "days_outside"))
        return
    found = model.baseline(place[0], place[1], place[2])
    for i, answer in enumerate(answers):
        answer |= {
            "baseline": _by_element(found.values[i]),
            "standard_error": _by_element(found.standard_error[i]),
            "days_outside": float(found.days_outside[i]),
            "weights": dict(zip(found.observatories, found.weights[i].tolist(), strict=True)),
            "dip_distance": float(found.dip_distance[i]),
            "polar": bool(found.polar[i]),
        }


def _add_fogm(
    answers: list[dict[str, Any]], model: TemporalModel, place: Place, kp: float | None
) -> None:
    if not model.classes:
        for answer in answers:
            answer |= dict.fromkeys(("sigma", "tau", "tau_unidentified", "classes"))
        return
    found = model.fogm(place[0], place[1], place[2], kp=kp)
    for i, answer in enumerate(answers):
        classes = {
            code: None if number < 0 else asdict(model.classes[number])
            for code, number in zip(found.observatories, found.classes[i].tolist(), strict=True)
        }
        answer |= {
            "sigma": _by_element(found.sigma[i]),
            "tau": _by_element(found.tau[i]),
            "tau_unidentified": dict(
                zip(_ELEMENTS, found.tau_unidentified[i].tolist(), strict=True)
            ),
            "classes": classes,
        }
        answer.setdefault(
            "weights", dict(zip(found.observatories, found.weights[i].tolist(), strict=True))
        )
        answer.setdefault("dip_distance", float(found.dip_distance[i]))
        answer.setdefault("polar", bool(found.polar[i]))


def _by_element(values: NDArray[np.float64]) -> dict[str, float]:
    return dict(zip(_ELEMENTS, values.tolist(), strict=True))


def print_temporal(answers: Sequence[dict[str, Any] | None]) -> None:
    """Print baseline, sigma and tau of the total, and who stands for them; nothing for None."""
    rows = []
    for answer in answers:
        if answer is None:
            return
        used = sorted(answer["weights"].items(), key=lambda item: -item[1])
        rows.append(
            (
                _number(answer["baseline"], ".1f"),
                _number(answer["standard_error"], ".1f"),
                _number(answer["sigma"], ".1f"),
                _number(answer["tau"], ".0f"),
                " ".join(f"{code} {weight:.0%}" for code, weight in used if weight >= 0.005),
                "polar" if answer["polar"] else "-",
            )
        )
    print()
    print_table(
        ("quiet day nT", "1 sigma", "FOGM sigma nT", "tau s", "observatories", "warning"), rows
    )


def _number(values: dict[str, float] | None, form: str) -> str:
    return "-" if values is None else f"{values['total']:{form}}"
