"""``boresight import``: measurements of other origin to a campaign file."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from estimator.models.errors import RequestError
from problems import console


def import_sentinel1(
    files: Annotated[
        list[Path],
        typer.Argument(
            metavar="FILES... OUT.nc",
            help="Annotation XML files and orbit files (.EOF) of one satellite, then the file to write.",
            show_default=False,
        ),
    ],
    as_json: Annotated[bool, typer.Option("--json", help="Machine-readable answer on standard output.")] = False,
) -> None:
    """Sentinel-1 annotations (several sub-swaths, slices, scenes) and orbit files to a campaign file."""
    console.run(lambda: _imported(files), as_json=as_json)


def _imported(files: list[Path]) -> tuple[dict[str, Any], Any]:
    """Import, write, and say what the campaign holds."""
    from problems.alignment.sentinel1_import import import_sentinel1 as campaign_from
    from problems.alignment.sentinel1_import import is_orbit_file
    from problems.readers.campaign_file import write_campaign

    *sources, target = files
    if target.suffix.lower() in {".xml", ".eof"} or not sources:
        raise RequestError(
            "the last argument is the campaign file to write",
            value=str(target),
            limit="OUT.nc",
            remedy="boresight import sentinel1 FILES... OUT.nc",
        )
    annotations = [f for f in sources if not is_orbit_file(f)]
    with console.progress() as bar:
        bar.add_task(f"reading {len(sources)} files", total=None)
        campaign = campaign_from(annotations, [f for f in sources if is_orbit_file(f)])
        write_campaign(campaign, target)
    doppler = campaign.doppler
    assert doppler is not None  # an import without Doppler estimates raises
    result = {
        "status": "ok",
        "why": f"{len(campaign.arcs)} acquisition(s) with {doppler.time.size} Doppler estimates of {len(annotations)} "
        f"annotation(s) written to {target}",
        "file": str(target),
        "title": campaign.title,
        "epoch": campaign.epoch,
        "acquisitions": [{"name": a.name, "start": a.start, "stop": a.stop} for a in campaign.arcs],
        "positions": campaign.gnss.time.size,
        "attitudes": campaign.star_tracker.time.size,
        "doppler_estimates": doppler.time.size,
    }
    return result, lambda: f"{result['why']}\n{campaign.title}, epoch {campaign.epoch}"
