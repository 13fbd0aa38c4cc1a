"""What a survey request may say, and what is said about a wrong one."""

from __future__ import annotations

import copy
import math
from pathlib import Path

import pytest

from estimator.models.errors import FileFormatError, InputError, NotFiniteError, RequestError
from guidance.survey_request import read_survey_request, survey_request

GOOD = {
    "orbit": {"epoch": "2025-06-21T08:30:00Z", "overhead": [40.5, 29.2], "pass": "ascending"},
    "area": [{"center": [40.5, 29.2], "length_km": 200, "width_km": 203}],
}


def changed(**tables: object) -> dict:
    values = copy.deepcopy(GOOD)
    for key, value in tables.items():
        if isinstance(value, dict) and isinstance(values.get(key), dict):
            values[key].update(value)
        elif key == "area" and isinstance(value, dict):
            values["area"][0].update(value)
        else:
            values[key] = value
    return values


def test_defaults_are_those_of_the_example():
    request = survey_request(GOOD)
    example = read_survey_request(Path(__file__).resolve().parents[1] / "examples" / "istanbul.toml")
    assert request.orbit == example.orbit
    assert request.camera == example.camera
    assert request.limits == example.limits
    assert request.image_rate == example.image_rate == 9.3e-3
    area = request.areas[0]
    assert (area.length, area.width, area.overlap, area.scans) == (200e3, 203e3, 0.05, None)
    assert area.image_motion == "constant"
    assert [(r.name, r.when, r.image_motion) for r in example.routes] == [
        ("Antalya", "before", "equalised"), ("Varna", "after", "along_track")]


def test_time_zone_is_taken_to_utc_and_units_to_si():
    request = survey_request(changed(orbit={"epoch": "2025-06-21T11:30:00+03:00"},
                                     limits={"rate_deg_s": 1.0, "off_nadir_deg": 30},
                                     area={"azimuth_deg": -10, "overlap_percent": 8, "scans": 4}))
    assert request.orbit.epoch.isoformat() == "2025-06-21T08:30:00"
    assert request.limits.rate == pytest.approx(math.radians(1.0))
    assert request.areas[0].azimuth == pytest.approx(math.radians(-10))
    assert (request.areas[0].overlap, request.areas[0].scans) == (0.08, 4)


@pytest.mark.parametrize(("values", "message"), [
    (changed(orbit={"epoch": "yesterday"}), "epoch.*2025-06-21T08:30:00Z"),
    (changed(orbit={"overhead": [95, 29]}), r"overhead\[0\].*95 deg.*at most 90"),
    (changed(orbit={"overhead": [40.5]}), "latitude, longitude"),
    (changed(orbit={"pass": "sideways"}), "ascending | descending"),
    (changed(orbit={"raan_deg": 10.0}), "given twice"),
    (changed(orbit={"eccentricity": 0.2}), "perigee"),
    (changed(orbit={"inclinaton_deg": 98}), "unknown key.*did you mean inclination_deg"),
    (changed(limits={"rate_deg_s": 0}), "rate_deg_s.*above 0"),
    (changed(limits={"jerk_deg_s3": -1}), "jerk_deg_s3"),
    (changed(limits={"acceleration_deg_s2": True}), "a number is expected"),
    (changed(camera={"along": [0, 1, 0]}), "perpendicular"),
    (changed(camera={"line_of_sight": [0, 0, 0]}), "no length"),
    (changed(camera={"field_deg": 0}), "field_deg"),
    (changed(image_motion={"rate_rad_s": 0}), "rate_rad_s"),
    (changed(image_motion={"speed": 1}), "unknown key"),
    (changed(area={"length_km": -3}), "length_km.*above 0"),
    (changed(area={"scans": 2.5}), '"auto" or a number'),
    (changed(area={"image_motion": "along_track"}), "constant | equalised"),
    (changed(area={"center": [-100, 3]}), "at least -90"),
    (changed(area=[{"center": [1, 2], "length_km": 3}]), "width_km.*add width_km"),
    (changed(route=[{"name": "x", "start": [1, 2], "length_km": 3, "when": "during"}]), "before | after"),
    (changed(weather={}), "unknown table"),
    ({"orbit": GOOD["orbit"]}, "nothing to survey"),
    ({"area": GOOD["area"]}, "orbit"),
    (changed(orbit=[1, 2]), "a table is expected"),
])
def test_bad_requests_say_what_is_wrong(values, message):
    with pytest.raises(RequestError, match=message):
        survey_request(values, "bad.toml")


def test_numbers_must_be_finite():
    with pytest.raises(NotFiniteError, match="length_km"):
        survey_request(changed(area={"length_km": float("nan")}))


def test_files_that_are_none(tmp_path):
    with pytest.raises(FileFormatError, match="cannot be read"):
        read_survey_request(tmp_path / "absent.toml")
    broken = tmp_path / "broken.toml"
    broken.write_text("[orbit\n")
    with pytest.raises(FileFormatError, match="no TOML"):
        read_survey_request(broken)
    broken.write_bytes(b"\xff\xfe\x00")
    with pytest.raises(InputError):
        read_survey_request(broken)
