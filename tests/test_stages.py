"""Stages of a method: seconds add up, and those of a pair are what the stop watch reports."""

from __future__ import annotations

import time
from typing import Any, List

from cflow_torch import make_config
from cflow_torch.stages import StopWatch, stage, stage_seconds


def test_the_stop_watch_times_pairs_and_stages() -> None:
    class Sleeper:
        config = make_config("paper")
        calls = 0

        def __call__(self, _: Any) -> List[Any]:
            self.calls += 1
            for _ in range(2):
                with stage("cluster"):
                    time.sleep(0.2 if self.calls == 1 else 0.01)
            time.sleep(0.01)
            return []

    watch = StopWatch(Sleeper())
    for _ in range(3):
        watch([])
    times = watch.report()
    assert times["pairs"] == 2 and times["max"] < 0.4, "the first pair does not count"
    assert 0.02 <= times["stages"]["cluster"] < times["median"] - 0.009
    with stage_seconds() as seconds, stage("outer"):
        pass
    assert list(seconds) == ["outer"], "no stage of before"
