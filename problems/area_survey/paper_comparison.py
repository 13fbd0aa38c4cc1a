"""The Istanbul survey beside the numbers of Somov, Butyrin, Makarov and of an independent reconstruction of their plan.

Run as ``python -m problems.area_survey.paper_comparison [--json]``. The article prints no limits on acceleration and
jerk; the last rows of the table show which ones its slews of 9.8 s (a third of a scan) would need.
"""

from __future__ import annotations

import json
import math
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

from guidance.survey_plan import SurveyPlan, plan_survey
from guidance.survey_request import SurveyRequest, read_survey_request

EXAMPLE = Path(__file__).resolve().parents[2] / "examples" / "istanbul.toml"
PAPER_SLEW = 9.8  # s, a third of the central scan of 29.4 s


def limits_for_slews(request: SurveyRequest, wanted: float, tolerance: float = 0.005) -> tuple[float, SurveyPlan]:
    """Factor on the acceleration and jerk limits at which the longest slew between area scans takes ``wanted`` s.

    Args:
        request: a survey; its routes are left out.
        wanted: s.
        tolerance: s.

    Returns:
        The factor and the plan under the limits so changed.
    """
    area = replace(request, routes=())

    def longest(factor: float) -> tuple[float, SurveyPlan]:
        limits = replace(request.limits, acceleration=request.limits.acceleration * factor,
                         jerk=request.limits.jerk * factor)
        plan = plan_survey(replace(area, limits=limits))
        return max(j.duration for j in plan.joins), plan

    low, high = 1.0, 2.0
    below, above = longest(low)[0], longest(high)[0]
    plan = longest(high)[1]
    for _ in range(12):
        factor = low + (high - low) * (below - wanted) / (below - above)
        found, plan = longest(factor)
        if abs(found - wanted) < tolerance:
            return factor, plan
        if found > wanted:
            low, below = factor, found
        else:
            high, above = factor, found
    return factor, plan


def comparison(plan: SurveyPlan) -> list[tuple[str, str, str, str]]:
    """Rows: quantity, this plan, the article, the reconstruction."""
    scans = plan.scans
    area = [s.scan for s in scans if s.kind == "area"]
    single = {s.name: s.scan for s in scans if s.kind == "route"}
    central = area[len(area) // 2]
    joins = [j for j in plan.joins if area[0].start < j.start < area[-1].stop]
    count = plan.areas[0].count
    rows = [
        ("scans of the area", str(len(area)), "5", "5"),
        ("number of scans, formula as printed", f"{count.printed:.2f}", "2b(1-p/50)/(s0+sm)",
         "3.98 (p = 5 %), 3.54 (10 %)"),
        ("number of scans, formula corrected", f"{count.corrected:.2f}", "-", "4.66 (p = 5 %), 4.92 (10 %)"),
        ("directions", "".join("+" if s.forward else "-" for s in area), "odd +, even -", "+-+-+"),
        ("central scan T_c, s", f"{central.duration:.2f}", "-", "29.4"),
        ("slews T_r, s", ", ".join(f"{j.duration:.2f}" for j in joins), "T_c / 3", "9.8; least 10.8 for 6 deg"),
        ("slew angles, deg", ", ".join(f"{math.degrees(j.angle):.1f}" for j in joins), "-", "4.4 to 7.3"),
        ("area T_a, s", f"{plan.area_duration:.2f}", "N T_c + (N - 1) T_r", "186.3 at constant T_c; 164.7 at T_c = 26"),
        ("off nadir, deg", f"{math.degrees(plan.off_nadir):.2f}", "at most 40", "35.6"),
        ("swaths of the area, km", ", ".join(f"{s.width / 1e3:.1f}" for s in area), "-",
         "42.4 to 53.8 (field 3.33 deg)"),
        ("rates in forward / reverse scans, deg/s",
         " ".join(f"{max(_rate(s)):.2f}" for s in area), "-", "0.06 / 0.86 to 1.03"),
    ]
    for name, length, width in (("Antalya", 54.78, 46.87), ("Varna", 135.92, 48.75)):
        if name in single:
            scan = single[name]
            rows.append((f"{name}: length x width, km", f"{scan.length / 1e3:.2f} x {scan.width / 1e3:.2f}",
                         f"{length} x {width}", "-"))
            field = math.degrees(plan.request.camera.field)
            rows.append((f"{name}: field that gives the article's width, deg",
                         f"{field * width * 1e3 / scan.width:.3f} (used: {field:.2f})", "-",
                         "3.3 to 3.7, with the duration of the area"))
    return rows


def _rate(scan: Any) -> list[float]:
    import numpy as np

    motion = scan.motion(np.linspace(scan.start, scan.stop, 50))
    return [math.degrees(float(v)) for v in np.linalg.norm(motion.rate, axis=1)]


def main(arguments: list[str]) -> None:
    """Print the comparison."""
    request = read_survey_request(EXAMPLE)
    plan = plan_survey(request)
    rows = comparison(plan)
    factor, faster = limits_for_slews(request, PAPER_SLEW)
    rows.append((f"limits for slews of {PAPER_SLEW} s", f"{0.2 * factor:.3f} deg/s2, {0.1 * factor:.3f} deg/s3 "
                 f"(area in {faster.area_duration:.2f} s)", "-", "0.34 deg/s2 by a polynomial of degree 5"))
    if "--json" in arguments:
        print(json.dumps([dict(zip(("quantity", "plan", "article", "reconstruction"), r, strict=True)) for r in rows]))
        return
    from rich.console import Console
    from rich.table import Table

    table = Table("quantity", "this plan", "article", "reconstruction", box=None)
    for row in rows:
        table.add_row(*row)
    Console(soft_wrap=True).print(table)


if __name__ == "__main__":
    main(sys.argv[1:])
