"""What stands the process still is done once; what makes it punctual is given back at rest."""

import gc
import os
from collections.abc import Iterator

import pytest

from viskill_deploy.core import realtime


@pytest.fixture(autouse=True)
def given_back() -> Iterator[None]:
    yield
    realtime.release()


def test_memory_is_frozen_once_and_stays_so_at_rest() -> None:
    realtime.settle()
    frozen = gc.get_freeze_count()
    assert frozen > 1000
    kept = [[] for _ in range(1000)]
    realtime.prepare()
    realtime.pause()
    # What came later is swept when it is garbage; of what was frozen something may have died since.
    assert frozen - len(kept) / 2 < gc.get_freeze_count() <= frozen
    realtime.release()
    assert gc.get_freeze_count() == 0
    assert len(kept) == 1000


def test_the_collector_is_off_only_while_the_process_has_to_be_punctual() -> None:
    realtime.prepare()
    assert not gc.isenabled()
    realtime.pause()
    assert gc.isenabled()
    assert os.sched_getscheduler(0) == os.SCHED_OTHER


def test_a_refusal_is_told_again_and_again(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: object) -> None:
        raise PermissionError("not permitted")

    monkeypatch.setattr(os, "sched_setscheduler", refuse)
    assert realtime.first_in_line()[0].startswith("no real-time scheduling (not permitted)")
    monkeypatch.setattr(realtime, "_settled", ["memory is not locked"])
    assert realtime.settle() == ["memory is not locked"]
    monkeypatch.undo()
