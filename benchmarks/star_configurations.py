"""Star configurations, measured: the published table, all random starts, the real sky, Monte Carlo against covariance.

    python -m benchmarks.star_configurations [--quick] [--catalogue FILE] [--results FILE.json]

Studies: ``table`` (every row of the published table against its minimum, both readings of its angles), ``starts``
(100 random starts for each N from 2 to 50), ``axis`` (K1: two stars under an angle limit, and the price of the limit
1/N), ``sky`` (1000 random attitudes, 8 stars to magnitude 5: time, proof, gap to exact enumeration where that is small
enough), ``monte_carlo`` (Wahba solutions against the predicted covariance on real stars).
"""

from __future__ import annotations

import argparse
import json
import time
from itertools import combinations
from math import comb
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from problems.readers.star_catalogue import read_star_catalogue
from problems.star_configuration import closed_form
from problems.star_configuration.catalogue_selection import Camera, Sky, select
from problems.star_configuration.criteria import criteria_of
from problems.star_configuration.optimal_directions import Request, optimal_directions, random_directions, solve_from

DEFAULT_CATALOGUE = Path(__file__).resolve().parents[1].parent / "shared" / "data" / "stars" / "bsc5-short.json"


def matrix_K0(directions: np.ndarray) -> float:
    """K0 by formula (3), sigma = 1."""
    return float(0.5 * np.trace(np.linalg.inv(len(directions) * np.eye(3) - directions.T @ directions)))


def table() -> list[dict[str, Any]]:
    """Excess of the published rows in both readings, and of ours."""
    rows = []
    for count in range(2, 11):
        least = closed_form.least_K0(count)
        published = closed_form.published_directions(count)
        latitude, longitude = (np.radians(np.array(a, dtype=float)) for a in closed_form.PUBLISHED_TABLE[count])
        printed = np.column_stack(
            (np.cos(latitude) * np.cos(longitude), np.cos(latitude) * np.sin(longitude), np.sin(latitude))
        )
        ours = optimal_directions(Request(count))
        rows.append(
            {
                "N": count,
                "least": least,
                "as_latitude_longitude": matrix_K0(printed) / least - 1,
                "as_azimuth_polar_angle": matrix_K0(published) / least - 1,
                "ours": matrix_K0(ours.directions) / least - 1,
                "closed_form_minus_matrix": closed_form.K0_any(published @ published.T) / matrix_K0(published) - 1,
                "seconds": ours.seconds,
            }
        )
    return rows


def starts(each: int) -> dict[str, Any]:
    """How many of ``each`` random starts per N end within 1e-9 of the minimum, without a second chance."""
    rows = []
    for count in range(2, 51):
        generator = np.random.default_rng(1000 + count)
        least = closed_form.least_K0(count)
        excess, seconds = [], []
        for _ in range(each):
            began = time.perf_counter()
            end = solve_from(Request(count), random_directions(count, generator), generator)
            seconds.append(time.perf_counter() - began)
            excess.append(matrix_K0(end.directions) / least - 1 if end.converged else np.inf)
        rows.append(
            {
                "N": count,
                "starts": each,
                "reached": int(np.sum(np.array(excess) < 1e-9)),
                "worst_excess": float(np.max(excess)),
                "median_seconds": float(np.median(seconds)),
            }
        )
    return {
        "rows": rows,
        "all_reached": all(row["reached"] == each for row in rows),
        "worst_excess": max(row["worst_excess"] for row in rows),
    }


def one_axis() -> dict[str, Any]:
    """K1: two stars under an angle limit, both senses; stars along the axis."""
    two = []
    for degrees in (10, 30, 45.572996, 60, 80):
        best = optimal_directions(Request(2, "K1", angle_limit=float(np.radians(degrees))))
        formula = closed_form.least_K1_two(np.cos(np.radians(degrees)))
        flipped = criteria_of(best.directions * np.array([[1.0], [-1.0]]), best.axis).K1
        two.append(
            {
                "limit_deg": degrees,
                "formula": formula,
                "ours": best.K1 / formula - 1,
                "other_sense": flipped / formula - 1,
            }
        )
    price = []
    for cone in (0.3, 0.1, 0.03, 0.01):
        best = optimal_directions(Request(4, "K1", axis_clearance=cone))
        about = float(best.axis @ best.covariance @ best.axis)
        price.append({"cone_rad": cone, "K1_times_N": 4 * best.K1, "variance_about_axis": about, "K0": best.K0})
    return {"two_stars": two, "four_stars_near_the_axis": price}


def sky_study(catalogue: Path, attitudes: int) -> list[dict[str, Any]]:
    """The best 8 stars to magnitude 5 for random attitudes; enumeration where there are at most 60,000 subsets."""
    sky = Sky(read_star_catalogue(catalogue))
    cases = (
        ("20 deg field (half-angle 10 deg), magnitude 5, K0", 10.0, 5.0, "K0"),
        ("20 deg field (half-angle 10 deg), magnitude 5, K1 of the boresight", 10.0, 5.0, "K1"),
        ("half-angle 20 deg, magnitude 5, K0", 20.0, 5.0, "K0"),
        ("half-angle 20 deg, magnitude 6, K0", 20.0, 6.0, "K0"),
    )
    rows = []
    for name, half_angle, magnitude, criterion in cases:
        camera = (Camera((0, 0, 1), float(np.radians(half_angle)), magnitude),)
        seconds, visible, proven, gaps, quick_gaps, first_bounds, enumerated, nodes = [], [], [], [], [], [], [], []
        for rotation in Rotation.random(attitudes, rng=np.random.default_rng(7)):
            began = time.perf_counter()
            candidates = sky.candidates(rotation, camera)
            chosen = select(candidates, 8, criterion=criterion)
            seconds.append(time.perf_counter() - began)
            visible.append(len(candidates))
            nodes.append(chosen.nodes)
            if chosen.status != "ok":
                continue
            proven.append(chosen.proven)
            gaps.append(chosen.gap)
            if len(candidates) > 8:
                quick = select(candidates, 8, criterion=criterion, exact=False)
                quick_gaps.append(quick.value / chosen.value - 1)
                first_bounds.append(quick.gap)
                if comb(len(candidates), 8) <= 60_000 and len(enumerated) < 300:
                    enumerated.append(chosen.value / enumerate_all(candidates.directions, 8, criterion) - 1)
        rows.append(
            {
                "case": name,
                "attitudes": attitudes,
                "median_ms": 1e3 * float(np.median(seconds)),
                "p95_ms": 1e3 * float(np.percentile(seconds, 95)),
                "max_ms": 1e3 * float(np.max(seconds)),
                "median_visible": float(np.median(visible)),
                "max_visible": int(np.max(visible)),
                "unobservable": attitudes - len(proven),
                "proven_optimal": int(np.sum(proven)),
                "largest_gap": float(np.max(gaps)),
                "most_branches": int(np.max(nodes)),
                "enumerated": len(enumerated),
                "largest_gap_to_enumeration": float(np.max(np.abs(enumerated), initial=0)),
                "quick_largest_excess": float(np.max(quick_gaps, initial=0)),
                "quick_share_optimal": float(np.mean(np.array(quick_gaps) < 1e-9)) if quick_gaps else None,
                "quick_largest_stated_gap": float(np.max(first_bounds, initial=0)),
            }
        )
    return rows


def enumerate_all(directions: np.ndarray, count: int, criterion: str) -> float:
    """The least criterion over all subsets, each by a matrix inverse (equal accuracies, body z for K1)."""
    rows = np.array(list(combinations(range(len(directions)), count)))
    chosen = directions[rows]
    p = 0.5 * np.linalg.inv(count * np.eye(3) - np.einsum("sni,snj->sij", chosen, chosen))
    values = np.trace(p, axis1=1, axis2=2)
    return float(np.min(values - p[:, 2, 2] if criterion == "K1" else values))


def monte_carlo(catalogue: Path, attitudes: int, samples: int) -> dict[str, Any]:
    """Wahba's solution on noisy sightings of the chosen stars, 10 arcsec total, against the predicted covariance.

    For each attitude the ratio of the mean square attitude error to K0 is compared with its own standard error.
    """
    sky = Sky(read_star_catalogue(catalogue))
    sigma = float(np.radians(10 / 3600))
    generator = np.random.default_rng(11)
    scores, ratios, entries = [], [], []
    for rotation in Rotation.random(attitudes, rng=generator):
        chosen = select(sky.candidates(rotation, (Camera((0, 0, 1), float(np.radians(10)), sigma=sigma),)), 8)
        if chosen.status != "ok":
            continue
        b = chosen.candidates.directions[chosen.chosen]
        noise = generator.standard_normal((samples, len(b), 3)) * sigma / np.sqrt(2)
        measured = b + noise - np.sum(noise * b, axis=2, keepdims=True) * b
        u, _, vt = np.linalg.svd(np.einsum("sni,nj->sij", measured, b))
        u[:, :, 2] *= (np.linalg.det(u) * np.linalg.det(vt))[:, None]
        errors = Rotation.from_matrix(u @ vt).as_rotvec()
        expected = chosen.criteria.covariance
        ratio = np.mean(np.sum(errors**2, axis=1)) / np.trace(expected)
        standard_error = np.sqrt(2 * np.trace(expected @ expected) / samples) / np.trace(expected)
        ratios.append(float(ratio))
        scores.append(float((ratio - 1) / standard_error))
        spread = np.sqrt((expected**2 + np.outer(np.diag(expected), np.diag(expected))) / samples)
        entries.append(float(np.max(np.abs(errors.T @ errors / samples - expected) / spread)))
    return {
        "attitudes": len(ratios),
        "samples_each": samples,
        "mean_ratio": float(np.mean(ratios)),
        "least_ratio": float(np.min(ratios)),
        "largest_ratio": float(np.max(ratios)),
        "rms_score": float(np.sqrt(np.mean(np.square(scores)))),
        "largest_entry_score": float(np.max(entries)),
    }


def show(rows: list[dict[str, Any]]) -> None:
    """Print rows as a table."""
    names = list(rows[0])
    print("  ".join(f"{n:>24s}" for n in names))
    for row in rows:
        print("  ".join(f"{row[n]:>24.6g}" if isinstance(row[n], float) else f"{row[n]!s:>24s}" for n in names))


def main() -> None:
    """Run the studies, print their tables and write their numbers."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="a tenth of the sample sizes")
    parser.add_argument("--catalogue", type=Path, default=DEFAULT_CATALOGUE)
    parser.add_argument("--results", type=Path, default=None)
    arguments = parser.parse_args()
    factor = 10 if arguments.quick else 1
    results: dict[str, Any] = {}

    results["table"] = table()
    show(results["table"])
    results["axis"] = one_axis()
    show(results["axis"]["two_stars"])
    show(results["axis"]["four_stars_near_the_axis"])
    results["starts"] = starts(100 // factor)
    show(results["starts"]["rows"])
    print(f"all reached: {results['starts']['all_reached']}, worst excess {results['starts']['worst_excess']:.3g}")
    if arguments.catalogue.exists():
        results["sky"] = sky_study(arguments.catalogue, 1000 // factor)
        for row in results["sky"]:
            print(json.dumps(row, indent=1))
        results["monte_carlo"] = monte_carlo(arguments.catalogue, 100 // factor, 10_000)
        print(json.dumps(results["monte_carlo"], indent=1))
    else:
        print(f"no catalogue at {arguments.catalogue}: the studies of the real sky are left out (--catalogue FILE)")
    if arguments.results is not None:
        from estimator.models.files import written_atomically

        with written_atomically(arguments.results) as temporary:
            temporary.write_text(json.dumps(results, indent=1), encoding="utf-8")


if __name__ == "__main__":
    main()
