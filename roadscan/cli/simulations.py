"""Commands of the simulator."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from roadscan.cli.arguments import AsJson, PlainJson, Workers, scenes_for
from roadscan.cli.survey import Where, run_survey, sum_up
from roadscan.cli.terminal import print_json, print_table


def simulate(
    scene: Annotated[
        str,
        typer.Argument(
            help="A scene file (TOML), or the name of a shipped scene (roadscan scenes).", autocompletion=scenes_for
        ),
    ],
    out: Annotated[Path, typer.Option(help="Folder to write to.")],
    hits: Annotated[bool, typer.Option("--hits", help="Also write where each beam hit, into truth/hits.")] = False,
    force: Annotated[
        bool, typer.Option("--force", help="Overwrite survey file, rig file and control points that were edited.")
    ] = False,
    seed: Annotated[int | None, typer.Option(min=0, help="Seed of all errors, in place of the scene's own.")] = None,
) -> None:
    """Write a survey with known truth as raw logs."""
    from roadscan.simulate import Scene
    from roadscan.simulate import simulate as write

    loaded = Scene.load(scene)
    changed = loaded if seed is None else loaded.changed(seed=seed)
    made = write(changed, out, write_hits=hits, progress=typer.echo, overwrite=force)
    typer.echo(
        f"{made.poses:,} poses, {made.profiles:,} profiles with {made.readings:,} readings in all, "
        f"{made.returns:,} returns"
    )
    typer.echo(f"survey file: {made.survey_file}")


def list_scenes(as_json: PlainJson = False) -> None:
    """List the scenes that ship with roadscan."""
    from roadscan.simulate import Scene
    from roadscan.simulate.scene import shipped_scenes

    scenes = {name: Scene.load(name) for name in shipped_scenes()}
    if as_json:
        print_json(
            [
                {"scene": name, "length_m": one.length_m, "passes": len(one.passes), "title": one.title}
                for name, one in scenes.items()
            ]
        )
        return
    print_table(
        ("scene", "length m", "passes", "what"),
        [(name, f"{one.length_m:g}", str(len(one.passes)), one.title) for name, one in scenes.items()],
    )


def demo(
    out: Annotated[Path, typer.Option(help="Folder to write to.")] = Path("demo"),
    workers: Workers = None,
    as_json: AsJson = False,
) -> None:
    """Simulate a small survey, run it, and compare the surface with the truth."""
    from roadscan.demo.demo import prepare_demo, summarise
    from roadscan.site.single import page_lines

    survey_file = prepare_demo(out, lambda text: typer.echo(text, err=as_json))
    run_survey(survey_file, None, Where(workers))
    compared, street = summarise(survey_file), _street_in_two_epochs(out / "street", workers, as_json)
    sum_up(survey_file, as_json, {"height_error_m": compared.height_error(), "inventory": street})
    for line in () if as_json else (*compared.lines(), *street, *page_lines(survey_file)):
        typer.echo(line)


def _street_in_two_epochs(folder: Path, workers: int | None, as_json: bool) -> list[str]:
    """Survey the demo's street twice, with an edit by hand between; what its inventory says then."""
    from roadscan.demo.demo import AUTUMN, SPRING, STAGES, compare_epochs, edit_by_hand, prepare_street

    files = [prepare_street(folder, epoch, lambda text: typer.echo(text, err=as_json)) for epoch in (SPRING, AUTUMN)]
    run_survey(files[0], STAGES, Where(workers))
    edit = edit_by_hand(files[0])
    run_survey(files[1], STAGES, Where(workers))
    return compare_epochs(files[1], edit)
