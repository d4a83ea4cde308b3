"""Drivers, workers and schedulers on hosts of their own are killed at drawn moments: nothing half done, same bytes.

`ROADSCAN_KILLS_APART` says how often, `ROADSCAN_SEED` which moments are drawn.
"""

from __future__ import annotations

import datetime as dt
import os
import random
import sys
import time
from collections import Counter
from typing import Final

import pytest

from roadscan.store.lease import LEASE_S
from tests.hosts.conftest import Cluster, assert_same, contents
from tests.hosts.host import Running
from tests.hosts.test_hosts_apart import RUN_S
from tests.kills.trial import store_faults

pytestmark = [pytest.mark.nightly, pytest.mark.timeout(0)]
KILLS: Final = int(os.environ.get("ROADSCAN_KILLS_APART", "12"))
LONGEST_S: Final = 25.0
"""Time within which a host is killed (s): most of a run without faults."""
GONE: Final = ("manifest/outputs", "tables/footprints", "tiles", "manifest/logs")
"""What is taken away from a finished store, to be made again."""


def test_hosts_that_are_killed(cluster: Cluster, alone: dict[str, bytes]) -> None:
    seed = int(os.environ.get("ROADSCAN_SEED", dt.date.today().toordinal()))
    chance, killed, gone = random.Random(seed), Counter[str](), "?"
    store = cluster.fresh("drawn")
    run: Running | None = None
    while killed.total() < KILLS:
        run = run or cluster.run(f"drawn-{killed.total()}-{time.monotonic_ns()}")
        if _ends_within(run, chance.uniform(0.5, LONGEST_S)):
            assert run.process.returncode == 0, run.said()
            assert_same(contents(store), alone)
            run, gone = None, GONE[killed.total() % len(GONE)]
            store.remove(gone)
            continue
        victim = chance.choice(("driver", "driver", "one", "two", "scheduler"))
        killed[victim] += 1
        cluster.stop(next(host for host in cluster.net.hosts if host.name == victim))
        assert list(store_faults(store, gone)) == []
        if victim == "driver":
            run = None
            time.sleep(LEASE_S + 1.0)  # the next driver is refused before: test_hosts_apart
        elif victim == "scheduler":
            if run.ended(90.0) == 0:  # it had no more tasks
                assert_same(contents(store), alone)
            assert "Traceback" not in run.said(), run.said()
            run = None
            cluster.restart()
        else:
            host = next(host for host in cluster.workers if host.name == victim)
            cluster.start_worker(host, log=f"again-{killed.total()}").wait_for("Registered to")
        assert list(store_faults(store, gone)) == []
        sys.__stderr__.write(f"seed {seed}: killed so far: {dict(killed)}\n")
    last = run or cluster.run("last")
    assert last.ended(RUN_S) == 0, last.said()
    assert_same(contents(store), alone)


def _ends_within(run: Running, seconds: float) -> bool:
    end = time.monotonic() + seconds
    while run.process.poll() is None and time.monotonic() < end:
        time.sleep(0.05)
    return run.process.poll() is not None
