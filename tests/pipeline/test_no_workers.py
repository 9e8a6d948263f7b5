"""A local cluster whose last worker has gone for good: the build ends, and says so."""

from __future__ import annotations

import os
import signal

import pytest
from distributed.core import Status

from magtiles.pipeline import tasks
from magtiles.pipeline.tasks import working
from magtiles.schemas.errors import MagtilesError


def test_work_that_no_worker_is_left_for_is_an_error(tmp_path, monkeypatch):
    # Workers cannot import this file: functions within functions are sent as they are.
    def die() -> None:
        os.kill(os.getpid(), signal.SIGKILL)

    monkeypatch.setattr(tasks, "_WORKER_BYTES", 1 << 62)  # one worker
    monkeypatch.setitem(tasks.CLUSTER_SETTINGS, "distributed.scheduler.no-workers-timeout", "1s")
    with working(None, [tmp_path]) as place:
        place.expand()
        place.tasks.submit(os.getpid).result()
        (nanny,) = place.tasks._starting.result().cluster.workers.values()
        nanny.status = Status.starting  # a worker that dies now is not replaced
        with pytest.raises(MagtilesError, match="workers died again and again"):
            place.tasks.submit(die).result()
