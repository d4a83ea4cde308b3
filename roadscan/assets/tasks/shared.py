"""Tables that the search of all squares shares."""

from __future__ import annotations

from typing import NamedTuple

import pyarrow as pa

from roadscan.assets.statistics import Statistics
from roadscan.store.manifest import OutputRecord, recorded_table
from roadscan.store.store import Store


class Shared(NamedTuple):
    """Records of the tables. Sent to workers: they carry no data."""

    statistics: OutputRecord
    gains: OutputRecord | None
    """None where intensities are used as recorded."""

    @property
    def key(self) -> tuple[str, str]:
        """Returns the digests of both."""
        return self.statistics.digest, "" if self.gains is None else self.gains.digest

    def read_gains(self, store: Store) -> pa.Table | None:
        """Returns the gains of the intensity; None where it is used as recorded."""
        return None if self.gains is None else recorded_table(store, self.gains)

    def read_statistics(self, store: Store) -> Statistics:
        """Returns the statistics of the survey."""
        rows = recorded_table(store, self.statistics)
        return Statistics(dict(zip(rows["statistic"].to_pylist(), rows["value"].to_pylist(), strict=True)))
