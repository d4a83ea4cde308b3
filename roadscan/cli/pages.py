"""The commands that show a survey in a browser."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import typer

from roadscan.cli.arguments import SurveyFile, options_apart


@dataclass(frozen=True)
class SiteOptions:
    """What a site is to hold."""

    box: Annotated[
        str | None, typer.Option(help="Only this part: WEST,SOUTH,EAST,NORTH in metres of the survey's map.")
    ] = None
    road: Annotated[str | None, typer.Option(help="Only the surroundings of this road of `reference_lines`.")] = None
    finest: Annotated[float, typer.Option(help="Leave out rasters with finer pixels than this (m).")] = 0.0
    clouds: Annotated[bool, typer.Option(help="With the points.")] = True
    pictures: Annotated[bool, typer.Option(help="With the pictures of cameras.")] = True
    privacy: Annotated[
        str | None,
        typer.Option(help="blur or off, in place of privacy.pictures of the survey file; without either no pictures."),
    ] = None
    edit: Annotated[
        bool, typer.Option("--edit", help="With edits of the inventory; the page saves them as a file to be pulled.")
    ] = False


@options_apart
def publish(
    survey_file: SurveyFile,
    out: Annotated[Path | None, typer.Option(help="Folder of the site; one that was published is renewed.")] = None,
    single: Annotated[Path | None, typer.Option(help="Write one HTML file with all in it, and no folder.")] = None,
    asked: SiteOptions = SiteOptions(),
    over: Annotated[
        list[Path] | None, typer.Option(help="Survey file of another survey of the roads, for strips over one another.")
    ] = None,
    largest: Annotated[float, typer.Option(help="--single: largest file (MB).")] = 200.0,
) -> None:
    """The survey as a page to look at: a folder for any web server with range requests, or one file."""
    from roadscan.cli.terminal import new_reporter
    from roadscan.core.counted import counted
    from roadscan.core.errors import ConfigError
    from roadscan.run.session import Session
    from roadscan.site.material import Material, Wishes, box_from_text, box_of_road
    from roadscan.site.single import write_single
    from roadscan.site.site import publish as published
    from roadscan.site.site_pictures import has_pictures
    from roadscan.site.web_part import HOW_TO_BUILD, web_folder

    if (out is None) == (single is None):
        raise ConfigError("publish takes a folder or a single file", expected="--out FOLDER or --single FILE.html")
    session, *others = (Session.open(file) for file in (survey_file, *(over or ())))
    for opened in (session, *others):
        opened.hear_of_damage()
    if asked.box is not None and asked.road is not None:
        raise ConfigError("--box and --road are both given", expected="one of them")
    near = box_from_text(asked.box) if asked.box is not None else None
    near = near if asked.road is None else box_of_road(Material(session), asked.road)
    edits: Literal["", "file"] = "file" if asked.edit else ""
    wishes = Wishes(asked.clouds, asked.pictures, asked.finest, near, edits, _privacy(asked.privacy))
    material = Material(session, wishes, tuple(others))
    if asked.pictures and material.privacy == "unstated" and has_pictures(material):
        typer.echo('note: no picture is published: state privacy.pictures = "blur" or "off", or --privacy')
    if asked.edit:
        material.check_edits()
    reporter = new_reporter()
    if single is not None:
        page = write_single(material, single, largest, lambda d, t: reporter.progress("publish", d, t))
        reporter.close()
        for one in page.left_out:
            typer.echo(f"left out: {one}")
        typer.echo(f"page: {single} ({page.bytes / 1e6:,.1f} MB)")
        return
    if out is not None:
        made = published(material, out, lambda d, t: reporter.progress("publish", d, t))
        reporter.close()
        told = [f"failed: {path}: {reason}" for path, reason in made.failures]
        told += [f"left out: {reason}" for reason in made.left_out]
        told += [f"damaged: {path} was not as it had been published, and was made again" for path in made.damaged]
        for line in told:
            typer.echo(line)
        if web_folder() is None:
            typer.echo(f"note: the folder holds the data without the page: {HOW_TO_BUILD}")
        typer.echo(f"site: {out} ({counted(made.files, 'file')}, {made.made:,} new, {made.bytes / 1e6:,.1f} MB)")
        if made.failures:
            raise typer.Exit(1)


def _privacy(stated: str | None) -> Literal["", "blur", "off"]:
    """What is done with people and vehicles in pictures, as the option says."""
    from roadscan.core.errors import ConfigError

    known: dict[str | None, Literal["", "blur", "off"]] = {None: "", "blur": "blur", "off": "off"}
    if stated in known:
        return known[stated]
    raise ConfigError(f"--privacy {stated}", expected="blur or off")


def view(
    survey_file: SurveyFile,
    port: Annotated[int, typer.Option(min=0, max=65535, help="Port of 127.0.0.1; 0: one that is free.")] = 0,
    over: Annotated[
        list[Path] | None, typer.Option(help="Survey file of another survey of the roads, for strips over one another.")
    ] = None,
    browser: Annotated[bool, typer.Option(help="Open the page in the browser.")] = True,
    edit: Annotated[
        bool,
        typer.Option(
            "--edit",
            help="Take edits from the page into the inventory, as `inventory pull` does, and control points that are "
            "clicked in pictures into a file.",
        ),
    ] = False,
    access: Annotated[
        Path | None,
        typer.Option(help="File that says who may see and edit the page behind a proxy that knows its users."),
    ] = None,
) -> None:
    """Look at the survey in a browser, while or after a run; Ctrl-C ends it.

    Without --access the page is for this machine alone.
    """
    import webbrowser

    from roadscan.site.access import Access
    from roadscan.site.doors import doors_of
    from roadscan.site.live import LiveSite, open_survey
    from roadscan.site.server import SiteServer
    from roadscan.site.web_part import HOW_TO_BUILD, web_folder

    allowed = None if access is None else Access.load(access)
    site = LiveSite(open_survey(survey_file, over or (), edited=edit))
    with SiteServer(site, port, doors_of(site, survey_file, edited=edit), allowed) as server:
        if web_folder() is None:
            typer.echo(f"note: the data are served without the page: {HOW_TO_BUILD}")
        typer.echo(f"page: {server.address} (Ctrl-C ends it)")
        if browser and allowed is None and web_folder() is not None:
            webbrowser.open(server.address)
        server.serve_forever()
