"""Commands that estimate what the sensors do not tell: their clocks and mountings."""

from __future__ import annotations

import typer

from roadscan.cli.arguments import SurveyFile
from roadscan.cli.survey import Where, opened_store, run_survey
from roadscan.cli.terminal import print_table


def clocks(survey_file: SurveyFile) -> None:
    """Clocks of sensors as they were estimated; estimates those that are missing or out of date."""
    from roadscan.navigation.tasks.trajectories import kept_estimates

    run = run_survey(survey_file, ["navigate"], Where(0))
    rows = [
        (e.run, e.sensor, f"{e.correction.offset_s:+.6f}", f"{e.correction.sigma_offset_s:.2g}",
         f"{e.correction.drift * 1e6:+.3f}", f"{e.correction.sigma_drift * 1e6:.2g}", e.method)
        for e in kept_estimates(run.store)
    ]  # fmt: skip
    if not rows:
        typer.echo("no clock to estimate: no log has clock = {…, pairs = …}, and the survey file names no [[clocks]]")
        return
    print_table(("run", "sensor", "added s", "σ s", "drift ppm", "σ ppm", "found from"), rows)


def calibrate(survey_file: SurveyFile) -> None:
    """Mountings of sensors from the evidence that the survey file names; readings are placed by them from then on."""
    from roadscan.calibrate.tasks.calibrate import PICTURE, calibrate_survey
    from roadscan.core.survey import Survey

    store = opened_store(survey_file)
    with store.lock():
        done = calibrate_survey(Survey.load(survey_file), store, typer.echo)
    typer.echo(done.text)
    typer.echo(f"written: table mountings, {store.path(PICTURE)}")
