"""The pictures that some tiles need: with their gains, and with what they show."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from roadscan.colours.kernels.looks import Depths
from roadscan.colours.painting import Palette
from roadscan.colours.tasks.depths import PictureGains, Shown, read_shown
from roadscan.colours.tasks.plan import DEPTHS, ColourPlan, numbers_near
from roadscan.compute.array_types import Float64, Int64
from roadscan.core.grid import Bounds
from roadscan.pictures.placed import Pictures
from roadscan.run.keys import key_of
from roadscan.store.digest import bytes_digest
from roadscan.store.manifest import Manifest, OutputRecord
from roadscan.store.store import Store


@dataclass(frozen=True, eq=False)
class PictureShare:
    """Pictures that some tiles need. Sent to workers: it carries no image."""

    pictures: Pictures
    number: Int64
    """(n,) number of each in the survey."""
    gain: Float64
    """(n, 3) factors of red, green and blue."""
    weight: Float64
    """(n,) by sharpness."""
    batch: Int64
    """(n,) index of its record."""
    row: Int64
    """(n,) row of it in the file of its batch."""
    records: tuple[OutputRecord, ...]
    """Files of what they show."""

    def key(self) -> str:
        """Returns a hash of all that colours from these pictures depend on."""
        values = b"".join(np.ascontiguousarray(a).tobytes() for a in (self.gain, self.weight, self.row))
        return key_of(self.pictures.key(), bytes_digest(values), [one.digest for one in self.records])

    def palette(self, store: Store) -> Palette:
        """Returns the pictures with all that their colours need."""
        return Palette(self.pictures, self.number, self.gain, self.weight, lambda: self._depths(store))

    def _depths(self, store: Store) -> Iterator[Depths]:
        held: list[Shown] = []
        known = -1
        for batch, row in zip(self.batch.tolist(), self.row.tolist(), strict=True):
            if batch != known:
                held, known = read_shown(store, self.records[batch]), batch
            yield held[row].depths


class Shares:
    """Hands out the pictures that tiles need, as far as it is known what they show."""

    def __init__(self, plan: ColourPlan, manifest: Manifest, gains: PictureGains) -> None:
        self._plan, self._gains = plan, gains
        self._records = [manifest.get(DEPTHS, one.unit) for one in plan.batches]
        self._row = np.zeros(len(plan.pictures), np.int64)
        order = np.argsort(plan.batch_of, kind="stable")
        starts = np.searchsorted(plan.batch_of[order], np.arange(len(plan.batches)))
        self._row[order] = np.arange(order.size) - starts[plan.batch_of[order]]
        known = np.array([one is not None for one in self._records], bool)
        self._known = known[plan.batch_of] if known.size else np.zeros(0, bool)

    def near(self, boxes: Sequence[Bounds], reach_m: float) -> PictureShare:
        """Returns the pictures that may show a point in one of some boxes of the map, within a reach (m)."""
        numbers = numbers_near(self._plan, boxes, reach_m)
        numbers = numbers[self._known[numbers]]
        batches, batch = np.unique(self._plan.batch_of[numbers], return_inverse=True)
        records = tuple(one for n in batches.tolist() if (one := self._records[n]) is not None)
        gains = self._gains
        return PictureShare(
            self._plan.pictures.chosen(numbers), numbers, gains.gain[numbers], gains.weight[numbers],
            batch.astype(np.int64), self._row[numbers], records,
        )  # fmt: skip
