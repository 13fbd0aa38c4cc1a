"""``boresight stars``: the best directions for N sensors, the best stars for an attitude, a plan for an orbit."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer
from rich.text import Text

from estimator.models.errors import RequestError
from problems.console import run, words

_Answer = tuple[dict[str, Any], Callable[[], object]]


def stars(
    n: Annotated[int, typer.Argument(metavar="N", help="Number of directions, or of stars to sight.")],
    criterion: Annotated[str, typer.Option(help="K0 (whole attitude) or K1 (one axis).")] = "K0",
    axis: Annotated[tuple[float, float, float], typer.Option(help="Body axis of K1.", metavar="X Y Z")] = (
        0.0,
        0.0,
        1.0,
    ),
    angle_limit: Annotated[
        float | None, typer.Option(help="Least angle between any two lines of sight, either sense [deg].")
    ] = None,
    minimum_angle: Annotated[float | None, typer.Option(help="Least angle between any two directions [deg].")] = None,
    maximum_angle: Annotated[
        float | None, typer.Option(help="Greatest angle between any two directions [deg].")
    ] = None,
    axis_clearance: Annotated[float | None, typer.Option(help="Least angle from the axis line, for K1 [deg].")] = None,
    keep_out: Annotated[
        list[str] | None,
        typer.Option(
            help='A cone to keep out of, "X Y Z HALF_ANGLE_DEG[ NAME]": body axes, or inertial axes with --catalogue.'
        ),
    ] = None,
    fixed: Annotated[list[str] | None, typer.Option(help='A sensor already on board, "X Y Z".')] = None,
    sigma: Annotated[
        list[float] | None, typer.Option(help="Accuracy of a direction, both axes together: one, or one for each.")
    ] = None,
    starts: Annotated[int | None, typer.Option(help="Starts of the optimiser.")] = None,
    family: Annotated[bool, typer.Option(help="Also all other optima: dimension of their family, members.")] = False,
    catalogue: Annotated[Path | None, typer.Option(help="Star catalogue (JSON or CSV): choose real stars.")] = None,
    attitude: Annotated[
        tuple[float, float, float, float] | None,
        typer.Option(help="inertial_from_body, scalar first.", metavar="W X Y Z"),
    ] = None,
    camera: Annotated[
        list[str] | None, typer.Option(help='A camera, "X Y Z[ STARS]": boresight in body axes, most stars.')
    ] = None,
    field_of_view: Annotated[float, typer.Option(help="Full width of the field of view [deg].")] = 20.0,
    magnitude_limit: Annotated[float, typer.Option(help="Faintest magnitude that is seen.")] = 5.0,
    blend: Annotated[float, typer.Option(help="Leave out stars this close to a brighter one [arcsec].")] = 0.0,
    epoch: Annotated[
        str | None, typer.Option(help="UTC: keep away from Sun, Moon and, with --position, the Earth.")
    ] = None,
    position: Annotated[
        tuple[float, float, float] | None,
        typer.Option(help="Inertial position from the Earth's centre [m], for the Earth's limb.", metavar="X Y Z"),
    ] = None,
    orbit: Annotated[Path | None, typer.Option(help="Plan request (TOML): sightings along an orbit.")] = None,
    page: Annotated[Path | None, typer.Option(help="Write an interactive page (HTML).")] = None,
    picture: Annotated[Path | None, typer.Option(help="Write a picture (PNG).")] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Machine-readable answer on standard output.")] = False,
) -> None:
    """Best star directions for N sensors; with --catalogue, the best stars for an attitude or along an orbit."""

    def work() -> _Answer:
        if catalogue is None:
            if attitude is not None or orbit is not None:
                raise RequestError(
                    "real stars need a catalogue", where="--attitude, --orbit", remedy="add --catalogue FILE"
                )
            return _directions(
                n,
                criterion,
                axis,
                angle_limit,
                minimum_angle,
                maximum_angle,
                axis_clearance,
                keep_out or [],
                fixed or [],
                sigma or [],
                starts,
                family,
                page,
                picture,
            )
        if orbit is not None:
            return _plan(n, criterion, axis, catalogue, blend, orbit, picture)
        return _selection(
            n,
            criterion,
            axis,
            catalogue,
            attitude,
            camera or [],
            field_of_view,
            magnitude_limit,
            blend,
            keep_out or [],
            epoch,
            position,
            sigma or [],
            page,
            picture,
        )

    run(work, as_json=as_json)


def _numbers(text: str, least: int, where: str, form: str) -> tuple[list[float], str]:
    """The numbers at the beginning of ``text`` and what follows them."""
    pieces = text.replace(",", " ").split()
    numbers: list[float] = []
    for piece in pieces:
        try:
            numbers.append(float(piece))
        except ValueError:
            break
    if len(numbers) < least or not np.all(np.isfinite(numbers)):
        raise RequestError("the numbers cannot be read", where=where, value=repr(text), limit=form)
    return numbers, " ".join(pieces[len(numbers) :])


def _cones(texts: list[str]) -> tuple[Any, ...]:
    from problems.star_configuration.optimal_directions import KeepOut

    cones = []
    for text in texts:
        numbers, name = _numbers(text, 4, "--keep-out", '"X Y Z HALF_ANGLE_DEG[ NAME]"')
        cones.append(KeepOut((numbers[0], numbers[1], numbers[2]), float(np.radians(numbers[3])), name or "cone"))
    return tuple(cones)


def _radians(angle: float | None) -> float | None:
    return None if angle is None else float(np.radians(angle))


def _directions(
    n: int,
    criterion: str,
    axis: tuple[float, float, float],
    angle_limit: float | None,
    minimum_angle: float | None,
    maximum_angle: float | None,
    axis_clearance: float | None,
    keep_out: list[str],
    fixed: list[str],
    sigma: list[float],
    starts: int | None,
    family: bool,
    page: Path | None,
    picture: Path | None,
) -> _Answer:
    """The best directions."""
    from problems.star_configuration.optimal_directions import Request, optimal_directions
    from problems.star_configuration.optimal_family import optimal_family

    if starts is not None and starts < 1:
        raise RequestError("the number of starts is out of range", where="--starts", value=starts, limit="1 or more")
    request = Request(
        count=n,
        criterion=criterion.upper(),
        axis=axis,
        sigma=1.0 if not sigma else sigma[0] if len(sigma) == 1 else tuple(sigma),
        minimum_angle=_radians(minimum_angle),
        maximum_angle=_radians(maximum_angle),
        angle_limit=_radians(angle_limit),
        axis_clearance=_radians(axis_clearance),
        keep_outs=_cones(keep_out),
        fixed=tuple((v[0], v[1], v[2]) for v, _ in (_numbers(t, 3, "--fixed", '"X Y Z"') for t in fixed)),
    )
    best = optimal_directions(request, starts=starts)
    result: dict[str, Any] = {
        "status": best.status,
        "why": best.why,
        "criterion": request.criterion,
        "K0": best.K0,
        "K1": best.K1,
        "axis": best.axis,
        "directions": best.directions,
        "covariance": best.covariance,
        "unobservable": best.unobservable,
        "starts": best.starts,
        "agreeing": best.agreeing,
        "seconds": best.seconds,
    }
    if family:
        began = time.perf_counter()
        every = optimal_family(request)
        result["family"] = {
            "dimension": every.dimension,
            "members": list(every.members),
            "local_optima": list(every.local_optima),
            "why": every.why,
            "seconds": time.perf_counter() - began,
        }
    if page is not None or picture is not None:
        from problems.star_configuration import figures

        if page is not None:
            figures.sphere_page(best, page)
            words.print(f"page written: {page}")
        if picture is not None:
            figures.sphere_picture(best, picture)
            words.print(f"picture written: {picture}")
    return result, lambda: Text(str(best) + (f"\n{result['family']['why']}" if family else ""))


def _selection(
    n: int,
    criterion: str,
    axis: tuple[float, float, float],
    file: Path,
    quaternion: tuple[float, float, float, float] | None,
    cameras_text: list[str],
    field_of_view: float,
    magnitude_limit: float,
    blend: float,
    keep_out: list[str],
    epoch: str | None,
    position: tuple[float, float, float] | None,
    sigma: list[float],
    page: Path | None,
    picture: Path | None,
) -> _Answer:
    """The best stars for one attitude."""
    from problems.star_configuration.catalogue_selection import select

    began = time.perf_counter()
    if quaternion is None:
        raise RequestError(
            "the attitude is missing", where="--attitude", remedy="give inertial_from_body as W X Y Z, or --orbit FILE"
        )
    if len(sigma) > 1:
        raise RequestError("one accuracy for all stars is needed here", where="--sigma", value=sigma, limit="one value")
    if not (0 < field_of_view <= 360):
        raise RequestError(
            "the field of view is out of range", where="--field-of-view", value=field_of_view, limit="0 to 360 deg"
        )
    cameras = _cameras(cameras_text, field_of_view, magnitude_limit, sigma[0] if sigma else 1.0)
    cones = _cones(keep_out)
    sky = _sky(file, blend)
    if epoch is not None:
        from problems.star_configuration.sighting_plan import keep_outs_at

        where = np.array([position]) if position is not None else np.zeros((1, 3))
        cones += keep_outs_at(
            epoch, np.zeros(1), where, earth_margin=np.radians(10.0) if position is not None else None
        )[0]
    candidates = sky.candidates(quaternion, cameras, cones)
    chosen = select(candidates, n, criterion=criterion.upper(), axis=axis)
    stars_chosen = [_star(sky.catalogue, candidates, i, cameras) for i in chosen.chosen]
    result = {
        "status": chosen.status,
        "why": chosen.why,
        "criterion": criterion.upper(),
        "K0": chosen.criteria.K0,
        "K1": chosen.criteria.K1,
        "axis": chosen.criteria.axis,
        "directions": candidates.directions[chosen.chosen],
        "stars": stars_chosen,
        "visible": len(candidates),
        "lower_bound": chosen.lower_bound,
        "gap": chosen.gap,
        "proven_optimal": chosen.proven,
        "covariance": chosen.criteria.covariance,
        "unobservable": chosen.criteria.unobservable,
        "keep_outs": [
            {"name": c.name, "direction": list(c.direction), "half_angle_deg": float(np.degrees(c.half_angle))}
            for c in cones
        ],
        "skipped_records": sky.catalogue.skipped,
        "selection_seconds": chosen.seconds,
        "seconds": time.perf_counter() - began,
    }
    if page is not None or picture is not None:
        from problems.star_configuration import figures

        if page is not None:
            figures.sky_page(chosen, sky.catalogue, cameras, page)
            words.print(f"page written: {page}")
        if picture is not None:
            figures.sky_picture(chosen, sky.catalogue, cameras, picture)
            words.print(f"picture written: {picture}")

    def text() -> Text:
        rows = [
            f"{s['camera']:10s} {s['identifier']:>8s} {s['name']:20s} {s['magnitude']:6.2f} "
            f"{s['right_ascension_deg']:11.5f} {s['declination_deg']:+10.5f}"
            for s in stars_chosen
        ]
        return Text(
            "\n".join(
                [
                    f"{chosen.status}: {chosen.why}",
                    f"K0 = {chosen.criteria.K0:.9g}  K1 = {chosen.criteria.K1:.9g}  "
                    f"visible {len(candidates)}  gap {chosen.gap:.3g}",
                    "camera         star name                    mag   RA [deg]    Dec [deg]",
                    *rows,
                ]
            )
        )

    return result, text


def _star(catalogue: Any, candidates: Any, i: int, cameras: tuple[Any, ...]) -> dict[str, Any]:
    s = int(candidates.star[i])
    return {
        "identifier": str(catalogue.identifier[s]),
        "name": str(catalogue.name[s]),
        "camera": cameras[int(candidates.camera[i])].name,
        "magnitude": float(catalogue.magnitude[s]),
        "right_ascension_deg": float(np.degrees(catalogue.right_ascension[s])),
        "declination_deg": float(np.degrees(catalogue.declination[s])),
        "direction": candidates.directions[i],
    }


def _cameras(texts: list[str], field_of_view: float, magnitude_limit: float, sigma: float) -> tuple[Any, ...]:
    from problems.star_configuration.catalogue_selection import Camera

    cameras = []
    for index, text in enumerate(texts or ["0 0 1"], start=1):
        numbers, name = _numbers(text, 3, "--camera", '"X Y Z[ STARS]"')
        most = int(numbers[3]) if len(numbers) > 3 else None
        cameras.append(
            Camera(
                (numbers[0], numbers[1], numbers[2]),
                float(np.radians(field_of_view)) / 2,
                magnitude_limit,
                most,
                sigma=sigma,
                name=name or f"camera {index}",
            )
        )
    return tuple(cameras)


def _sky(file: Path, blend: float) -> Any:
    from problems.readers.star_catalogue import read_star_catalogue
    from problems.star_configuration.catalogue_selection import Sky

    if not 0 <= blend < 36000:
        raise RequestError("the blend angle is out of range", where="--blend", value=blend, limit="0 to 36000 arcsec")
    found = read_star_catalogue(file)
    return Sky(found.without_blends(float(np.radians(blend / 3600))) if blend > 0 else found)


def _plan(
    n: int,
    criterion: str,
    axis: tuple[float, float, float],
    file: Path,
    blend: float,
    orbit: Path,
    picture: Path | None,
) -> _Answer:
    """The plan of sightings along an orbit."""
    from problems.star_configuration.sighting_plan import plan_from_request, read_plan_request

    began = time.perf_counter()
    request = read_plan_request(orbit)
    plan, _ = plan_from_request(_sky(file, blend), request, n, criterion=criterion.upper(), axis=axis)
    if picture is not None:
        from problems.star_configuration.figures import plan_picture

        plan_picture(plan, picture)
        words.print(f"picture written: {picture}")
    result = {
        "status": plan.status,
        "why": plan.why,
        "criterion": criterion.upper(),
        "axis": np.array(axis),
        "times_s": plan.times,
        "K0": plan.K0,
        "K1": plan.K1,
        "best": plan.best,
        "axis_sigma": plan.axis_sigma,
        "acquisitions": plan.acquisitions,
        "arcs": [
            {
                "identifier": a.identifier,
                "name": a.name,
                "camera": a.camera,
                "magnitude": a.magnitude,
                "start_s": a.start,
                "end_s": a.end,
            }
            for a in plan.arcs
        ],
        "dark_s": plan.dark,
        "seconds": time.perf_counter() - began,
    }
    return result, lambda: Text(str(plan))
