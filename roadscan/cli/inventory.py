"""Commands of the inventory of assets."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from roadscan.cli.arguments import PlainJson, SurveyFile, SurveyOption
from roadscan.cli.terminal import print_json, print_table

if TYPE_CHECKING:
    from roadscan.inventory.inventory import Inventory

AsOf = Annotated[str | None, typer.Option("--as-of", help="A day (UTC), an instant with zone, or a commit's number.")]
Who = Annotated[str | None, typer.Option(help="Who did it; the user of this computer where it is left out.")]
Why = Annotated[str, typer.Option(help="Why it was done; kept with it.")]
Home = Annotated[
    str | None,
    typer.Option(
        help="Another home: a copy of the GeoPackage, an address of PostGIS, or the edits (.geojson) that a page saved."
    ),
]
_PAGE_EDITS = (".geojson", ".json")
_MOST_LINES = 200  # lines that a terminal shows


def publish(
    survey_file: SurveyFile,
    discard: Annotated[bool, typer.Option("--discard", help="Drop changes of the home that were not pulled.")] = False,
) -> None:
    """Take in what the newest run found, and show the inventory in its home."""
    done = _opened(survey_file).publish(discard=discard)
    if done.recorded is not None:
        typer.echo(f"commit {done.recorded.number}: found in epoch {done.recorded.epoch}")
    conflicts = f", {done.conflicts} conflicts to settle" if done.conflicts else ""
    typer.echo(f"{done.home}: {done.assets:,} assets as of commit {done.commit}{conflicts}")


def pull(
    survey_file: SurveyFile,
    home: Home = None,
    who: Who = None,
    why: Why = "",
    sound: Annotated[bool, typer.Option("--sound", help="Take in sound rows where others are faulty.")] = False,
    confirm: Annotated[
        list[str] | None,
        typer.Option(
            help="An asset whose unlikely place or size is right, or a layer whose assets are gone, as `pull` names "
            "them; `all`: each. May be repeated."
        ),
    ] = None,
) -> None:
    """Take in what people changed in the home."""
    from roadscan.inventory.of_survey import edits_of_file, home_of, open_inventory, page_document
    from roadscan.run.session import Session

    session = Session.open(survey_file)
    inventory = open_inventory(session)
    if home is not None and home.endswith(_PAGE_EDITS):
        document = page_document(session, home, edits_of_file(Path(home)))
        done, _ = inventory.pull_page(document, who=who, why=why, sound=sound, confirm=confirm or ())
    else:
        place = None if home is None else home_of(session, home)
        done = inventory.pull(home=place, who=who, why=why, sound=sound, confirm=confirm or ())
    for fault in done.refused:
        typer.echo(f"{'asked' if fault.is_question else 'refused'}: {fault}")
    for finding in done.findings:
        typer.echo(f"doubtful: {finding.line}")
    assets = len({edit.asset_id for edit in done.edits})
    new = f"commit {done.commit}: {len(done.edits):,} values of {assets:,} assets" if done.commit else "nothing new"
    conflicts = f"; {done.conflicts} conflicts to settle" if done.conflicts else ""
    typer.echo(f"{new}{conflicts}")
    if done.refused:
        raise typer.Exit(1)


def status(survey_file: SurveyFile, as_of: AsOf = None) -> None:
    """How many assets there are, what is to be pulled and published, and the conflicts."""
    inventory = _opened(survey_file)
    if as_of is not None:
        state = inventory.state(as_of)
        print_table(("kind", "assets"), [(kind, str(own.ids.size)) for kind, own in state.assets.items()])
        typer.echo(f"as of commit {state.commit}")
        return
    found = inventory.status()
    names = ("found", "missing", "confirmed", "rejected")
    rows = [(kind, *(f"{counts.get(name, 0):,}" for name in names)) for kind, counts in found.assets.items()]
    print_table(("kind", *names), rows)
    typer.echo(f"{found.commits} commits; epochs: {', '.join(found.epochs) or 'none'}")
    shown = "not published yet" if found.published is None else f"shows commit {found.published}"
    typer.echo(f"{found.home}: {shown}, {found.to_pull} changes to pull, {found.to_publish} commits to publish")
    for one in inventory.conflicts()[:_MOST_LINES]:
        away = "" if one.sigmas is None else f" ({one.sigmas:.1f} σ)"
        typer.echo(f"conflict: {one.asset_id}, {one.attribute}: {one.reason}{away}, edited by {one.who}")


def diff(
    survey_file: SurveyOption,
    before: Annotated[str, typer.Argument(help="A day (UTC), an instant with zone, or a commit's number.")],
    after: Annotated[str | None, typer.Argument(help="The same; today where it is left out.")] = None,
    as_json: PlainJson = False,
) -> None:
    """What differs between two times."""
    from roadscan.inventory.diff import shown

    found = _opened(survey_file).diff(before, after)
    if as_json:
        print_json([one._asdict() for one in found])
        return
    rows = [(d.change, d.asset_id, d.attribute, *(shown(d) if d.attribute else ("", ""))) for d in found[:_MOST_LINES]]
    print_table(("change", "asset", "attribute", "before", "after"), rows)
    _tell_rest(len(found))


def changes(
    survey_file: SurveyOption,
    before: Annotated[
        str | None, typer.Argument(help="Name of an epoch; the last but one where it is left out.")
    ] = None,
    after: Annotated[str | None, typer.Argument(help="Name of a later one; the last where it is left out.")] = None,
) -> None:
    """What changed on the road between two survey epochs: appeared, gone, moved, changed."""
    found = _opened(survey_file).changes(before, after)
    if found is None:
        typer.echo("there is one epoch at most: nothing to compare")
        return
    rows = [
        (
            c.change, c.asset_id, c.attribute, c.before or "", c.after or "",
            "" if c.significance is None else f"{c.significance:.1f}",
            "" if c.distance_m is None else f"{c.distance_m:.2f}",
        )
        for c in found.changes[:_MOST_LINES]
    ]  # fmt: skip
    typer.echo(f"{found.before} to {found.after}")
    print_table(("change", "asset", "attribute", "before", "after", "σ", "m"), rows)
    _tell_rest(len(found.changes))
    if found.unseen:
        typer.echo(f"{found.unseen} assets were not seen, and may not have been in sight")


def history(
    survey_file: SurveyOption,
    asset: Annotated[str, typer.Argument(help="Id of the asset.")],
    as_json: PlainJson = False,
) -> None:
    """All that was found of an asset and edited."""
    events = _opened(survey_file).history(asset)
    if as_json:
        print_json([event._asdict() for event in events])
        return
    rows = [(str(e.commit), e.at, e.who, e.what, e.attribute, _short(e.old), _short(e.new), e.why) for e in events]
    print_table(("commit", "when", "who", "what", "attribute", "old", "new", "why"), rows)


def undo(
    survey_file: SurveyOption,
    commit: Annotated[int, typer.Argument(help="Number of the commit.")],
    who: Who = None,
    why: Why = "",
) -> None:
    """Undo a commit: a run, a pull, or another undoing. All of them stay in the history."""
    done = _opened(survey_file).undo(commit, who, why)
    typer.echo(f"commit {done.number} undoes commit {commit}; `roadscan inventory publish` shows it")


def log(survey_file: SurveyFile, as_json: PlainJson = False) -> None:
    """All commits: what was found, edited and undone, by whom and why."""
    commits = _opened(survey_file).truth.commits
    if as_json:
        print_json([dataclasses.asdict(commit) for commit in commits])
        return
    rows = [
        (
            str(c.number),
            c.at,
            c.kind,
            c.epoch or (f"commit {c.undoes}" if c.undoes else ""),
            f"{c.rows:,}",
            c.who,
            c.why,
        )
        for c in commits
    ]
    print_table(("commit", "when", "kind", "of", "rows", "who", "why"), rows)


def export(
    survey_file: SurveyFile,
    out: Annotated[Path, typer.Option(help="File to write.")],
    form: Annotated[str, typer.Option("--as", help="gpkg, geojson, csv or dxf.")] = "gpkg",
    as_of: AsOf = None,
) -> None:
    """Write the inventory as a file of another program."""
    count = _opened(survey_file).export(out, form, as_of)
    typer.echo(f"{count:,} assets in {out}")


def _opened(survey_file: Path) -> Inventory:
    from roadscan.inventory.of_survey import open_inventory
    from roadscan.run.session import Session

    return open_inventory(Session.open(survey_file))


def _tell_rest(count: int) -> None:
    typer.echo(
        f"{count:,} in all" if count <= _MOST_LINES else f"{count:,} in all, of which the first {_MOST_LINES} are shown"
    )


def _short(text: str | None) -> str:
    if text is None:
        return ""
    return text if len(text) <= 40 else f"{text[:37]}…"
