"""Stage `products`: mosaics, pictures and tables over all tiles."""

from __future__ import annotations

from collections.abc import Sequence

from roadscan.georeference.plan.plan import plan_of
from roadscan.run.session import Session
from roadscan.run.stage import Stage, StageState
from roadscan.tiles.mosaics.products import make_products, wanted_outputs
from roadscan.tiles.product import SurfaceProduct, SurveyProduct, products
from roadscan.tiles.tasks.cell_size import density_notes


class Products(Stage):
    """What spans many tiles, from their cells, overviews and surfaces."""

    name = "products"
    title = "mosaics, pictures and tables over all tiles"
    after = ("surfaces",)
    units = "files"
    reads = ("cells", "overviews", "trajectory", SurfaceProduct)
    writes = (SurveyProduct,)

    def run(self, session: Session) -> None:
        """Make the files that are missing or stale."""
        failures = make_products(plan_of(session), session.manifest, session.compute, session.bar(self.name))
        session.failed(self.name, failures)
        for note in density_notes(session.survey, session.store, session.manifest):
            session.note(note)

    def state(self, session: Session) -> StageState:
        """Files that are missing or stale."""
        wanted, _ = wanted_outputs(plan_of(session), session.manifest)
        state = StageState.of(session.manifest, [one.unit for one in wanted])
        state.notes = density_notes(session.survey, session.store, session.manifest)
        return state

    def folders(self) -> Sequence[str]:
        """A folder a product."""
        return [f"products/{name}" for name in _of_survey()]


def _of_survey() -> list[str]:
    return [name for name, product in products().items() if isinstance(product, SurveyProduct)]
