"""Reading star catalogues: the Yale form, tables of other kinds, and files that are not fit."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from estimator.models.errors import BoresightError, FileFormatError, MissingDataError, RequestError, UnitError
from problems.readers.star_catalogue import StarCatalogue, read_star_catalogue

YALE = Path(__file__).resolve().parents[1].parent / "shared" / "data" / "stars" / "bsc5-short.json"

RECORDS = [
    {"Dec": "+45° 13′ 45″", "HR": "1", "K": "9750", "RA": "00h 05m 09.9s", "V": "6.70"},
    {"Dec": "-00° 30′ 11″", "HR": "2", "RA": "00h 05m 03.8s", "V": "6.29"},
    {"Dec": "-16° 42′ 58″", "HR": "2491", "N": "Sirius", "RA": "06h 45m 08.9s", "V": "-1.46"},
]


def write(path: Path, content: object) -> Path:
    path.write_text(content if isinstance(content, str) else json.dumps(content), encoding="utf-8")
    return path


def test_yale_records(tmp_path: Path) -> None:
    stars = read_star_catalogue(write(tmp_path / "a.json", RECORDS))
    assert len(stars) == 3 and stars.skipped == 0
    assert list(stars.identifier) == ["1", "2", "2491"] and stars.name[2] == "Sirius"
    assert np.degrees(stars.right_ascension[0]) == pytest.approx(15 * (5 / 60 + 9.9 / 3600))
    assert np.degrees(stars.declination[0]) == pytest.approx(45 + 13 / 60 + 45 / 3600)
    assert np.degrees(stars.declination[1]) == pytest.approx(-(30 / 60 + 11 / 3600))  # the sign of minus zero degrees
    assert stars.magnitude[2] == -1.46
    np.testing.assert_allclose(np.linalg.norm(stars.directions(), axis=1), 1, atol=1e-15)


def test_the_whole_yale_catalogue() -> None:
    if not YALE.exists():
        pytest.skip(f"the Yale catalogue is not at {YALE}; the generated records above stand in for it")
    from astropy.coordinates import SkyCoord

    stars = read_star_catalogue(YALE)
    assert len(stars) == 9096
    assert len(stars.brighter_than(5.0)) == 1630
    brightest = int(np.argmin(stars.magnitude))
    assert stars.name[brightest] == "Sirius"
    raw = json.loads(YALE.read_text(encoding="utf-8"))
    chosen = np.random.default_rng(0).choice(len(raw), 200, replace=False)
    text = [f"{raw[i]['RA']} {raw[i]['Dec'].replace('°', 'd').replace('′', 'm').replace('″', 's')}" for i in chosen]
    expected = SkyCoord(text).cartesian.xyz.value.T  # astropy's own parser
    np.testing.assert_allclose(stars.directions()[chosen], expected, atol=1e-14)


@pytest.mark.parametrize(
    "text",
    [
        "id,ra,dec,mag\n7,101.287155,-16.716116,-1.46\n8,10,20,3\n",
        "# made by hand\nHIP;RAJ2000;DEJ2000;Vmag\n7;06:45:08.917;-16:42:58.02;-1.46\n8;10;20;3\n",
        "id\tra_hours\tdec_deg\tvmag\n7\t6.752477\t-16.716116\t-1.46\n8\t0.6667\t20\t3\n",
        "id,ra,dec,rarad,decrad,mag\n7,6.75,-16.7,1.767794350,-0.291751259,-1.46\n8,0.67,20,0.17453,0.34907,3\n",
    ],
)
def test_tables_of_other_kinds_give_the_same_star(tmp_path: Path, text: str) -> None:
    stars = read_star_catalogue(write(tmp_path / "a.csv", text))
    assert len(stars) == 2 and stars.identifier[0] == "7"
    assert np.degrees(stars.right_ascension[0]) == pytest.approx(101.28715, abs=2e-5)
    assert np.degrees(stars.declination[0]) == pytest.approx(-16.71612, abs=2e-5)


def test_json_by_columns_and_under_a_key(tmp_path: Path) -> None:
    by_columns = read_star_catalogue(
        write(tmp_path / "a.json", {"id": [1, 2], "ra": [10.0, 20.0], "dec": [1.0, 2.0], "mag": [3, 4]})
    )
    under_key = read_star_catalogue(
        write(
            tmp_path / "b.json",
            {
                "epoch": 2000,
                "stars": [{"id": 1, "ra": 10, "dec": 1, "mag": 3}, {"id": 2, "ra": 20, "dec": 2, "mag": 4}],
            },
        )
    )
    np.testing.assert_array_equal(by_columns.directions(), under_key.directions())


def test_records_without_a_position_are_left_out_and_counted(tmp_path: Path) -> None:
    stars = read_star_catalogue(
        write(tmp_path / "a.json", [*RECORDS, {"HR": "92", "RA": "", "Dec": "", "V": "5"}, {"HR": "95", "V": "5"}])
    )
    assert len(stars) == 3 and stars.skipped == 2


def test_proper_motion_moves_the_star(tmp_path: Path) -> None:
    """Barnard's star, 10.39 arcsec a year."""
    table = "id,ra,dec,mag,pmra,pmdec\nB,269.4520769586187,4.693364966,9.5,-801.551,10362.394\n"
    stars = read_star_catalogue(write(tmp_path / "a.csv", table))
    now, then = stars.directions()[0], stars.directions(10.0)[0]
    assert np.degrees(np.arccos(now @ then)) * 3600 == pytest.approx(103.93, abs=0.01)
    assert then[2] > now[2]


def test_blends_keep_the_brighter_star() -> None:
    ra = np.radians([10.0, 10.001, 50.0])
    stars = StarCatalogue(
        np.array(["a", "b", "c"]), np.array(["", "", ""]), ra, np.zeros(3), np.array([4.0, 2.0, 3.0]), np.zeros((3, 2))
    )
    assert list(stars.without_blends(np.radians(0.01)).identifier) == ["b", "c"]
    assert len(stars.without_blends(np.radians(1e-4))) == 3


@pytest.mark.parametrize(
    ("content", "error", "words"),
    [
        ("", FileFormatError, "header"),
        ('[{"RA": ', FileFormatError, "JSON"),
        ("[1, 2]", FileFormatError, "list of star records"),
        ("id,ra,dec\n1,2,3\n", MissingDataError, "magnitude"),
        ("id,ra,dec,mag\n1,2\n", FileFormatError, "short"),
        ("id,ra,dec,mag\n1,2,95,3\n", UnitError, "declination"),
        ("id,ra,dec,mag\n1,400,5,3\n", UnitError, "right ascension"),
        ("id,ra,dec,mag\n1,2,5,99\n", UnitError, "magnitude"),
        ("id,ra,dec,mag\n1,2,5,bright\n", FileFormatError, "number"),
        ("id,ra,dec,mag\n1,north,5,1\n", FileFormatError, "angle"),
        ("id,ra,dec,mag\n1,inf,5,1\n", BoresightError, "finite"),
        ("id,ra,dec,mag\n1,,,1\n", MissingDataError, "no star"),
        ({"ra": [1.0, 2.0], "dec": [1.0], "mag": [1, 2]}, FileFormatError, "length"),
    ],
)
def test_files_that_are_not_fit_are_refused_with_reasons(
    tmp_path: Path, content: object, error: type[Exception], words: str
) -> None:
    with pytest.raises(error, match=words):
        read_star_catalogue(write(tmp_path / "a.txt", content))


def test_missing_binary_and_ambiguous_files(tmp_path: Path) -> None:
    with pytest.raises(FileFormatError, match="no such file"):
        read_star_catalogue(tmp_path / "none.json")
    (tmp_path / "b.csv").write_bytes(b"\xff\xfe\x00\x80")
    with pytest.raises(FileFormatError, match="cannot be read"):
        read_star_catalogue(tmp_path / "b.csv")
    rows = "".join(f"{i},{24 * i / 300:.5f},{(i % 170) - 85},3\n" for i in range(300))
    hours = write(tmp_path / "h.csv", "id,ra,dec,mag\n" + rows)
    with pytest.raises(UnitError, match="look like hours"):
        read_star_catalogue(hours)
    assert np.degrees(read_star_catalogue(hours, right_ascension_unit="hour").right_ascension.max()) == pytest.approx(
        358.8
    )
    with pytest.raises(RequestError):
        read_star_catalogue(hours, right_ascension_unit="gon")
