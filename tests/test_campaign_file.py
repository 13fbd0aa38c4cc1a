"""The campaign file: what is written is read back bit for bit, and every form that the format allows is understood."""

from __future__ import annotations

import dataclasses
import tracemalloc
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest

from estimator.models.errors import FileFormatError, MissingDataError, ShapeError, UnitError
from problems.alignment.campaign import Campaign, Covariate, GnssSeries
from problems.alignment.checks import checked
from problems.alignment.simulator import preset, simulate
from problems.readers import campaign_file
from problems.readers.campaign_file import read_campaign, write_campaign

DATA = Path(__file__).resolve().parents[1].parent / "shared" / "data" / "campaigns"


@pytest.fixture(scope="module")
def simulated() -> Campaign:
    """A generated campaign with every channel, one accuracy for each sample, and housekeeping."""
    campaign, _ = simulate(preset("compact", noise_variation=1.0, housekeeping=True), seed=4)
    return checked(campaign)


@pytest.fixture(scope="module")
def plain() -> Campaign:
    """A generated campaign with constant accuracies and without housekeeping."""
    return checked(simulate(preset("compact"), seed=5)[0])


def assert_same(one: Any, other: Any, where: str = "campaign") -> None:
    """Bit for bit, field by field."""
    if dataclasses.is_dataclass(one):
        assert type(one) is type(other), where
        for field in dataclasses.fields(one):
            assert_same(getattr(one, field.name), getattr(other, field.name), f"{where}.{field.name}")
    elif isinstance(one, np.ndarray):
        assert one.shape == other.shape and one.dtype == other.dtype, where
        assert one.tobytes() == other.tobytes(), where
    elif isinstance(one, tuple):
        assert len(one) == len(other), where
        for k, (a, b) in enumerate(zip(one, other, strict=True)):
            assert_same(a, b, f"{where}[{k}]")
    elif isinstance(one, dict):
        assert one.keys() == other.keys(), where
        for key in one:
            assert_same(one[key], other[key], f"{where}[{key}]")
    else:
        assert one == other, where


def variants(campaign: Campaign) -> dict[str, Campaign]:
    """The campaign with parts left out and with beams that move."""
    doppler = campaign.doppler
    assert doppler is not None
    moving = np.repeat(doppler.beam_direction[None], doppler.time.size, axis=0)
    angle = 0.02 * np.sin(doppler.time / 100)
    turn = np.stack(
        [
            np.cos(angle),
            -np.sin(angle),
            0 * angle,
            np.sin(angle),
            np.cos(angle),
            0 * angle,
            0 * angle,
            0 * angle,
            1 + 0 * angle,
        ],
        axis=1,
    ).reshape(-1, 3, 3)
    moving = np.einsum("nij,nkj->nki", turn, moving)
    moving /= np.linalg.norm(moving, axis=2, keepdims=True)

    def only(*kinds: str) -> tuple:
        return tuple(a for a in campaign.arcs if a.kind in kinds)

    return {
        "whole": campaign,
        "moving beams": dataclasses.replace(campaign, doppler=dataclasses.replace(doppler, beam_direction=moving)),
        "no torque": dataclasses.replace(campaign, torque=None, arcs=only("doppler", "free_rotation")),
        "no rotation": dataclasses.replace(campaign, torque=None, arcs=only("doppler")),
        "no Doppler": dataclasses.replace(campaign, doppler=None, arcs=only("free_rotation", "torque_pulse")),
        "orbit and attitude alone": dataclasses.replace(campaign, doppler=None, torque=None, arcs=()),
        "no housekeeping": dataclasses.replace(campaign, housekeeping={}),
    }


@pytest.mark.parametrize(
    "name",
    ["whole", "moving beams", "no torque", "no rotation", "no Doppler", "orbit and attitude alone", "no housekeeping"],
)
def test_round_trip_is_exact(name: str, simulated: Campaign, plain: Campaign, tmp_path: Path) -> None:
    for campaign in (simulated, plain):
        wanted = checked(variants(campaign)[name])
        write_campaign(wanted, tmp_path / "a.nc")
        first = read_campaign(tmp_path / "a.nc")
        assert_same(first, wanted)
        write_campaign(first, tmp_path / "b.nc")
        assert_same(read_campaign(tmp_path / "b.nc"), first)


def test_written_file_has_the_layout_of_the_format(plain: Campaign, simulated: Campaign, tmp_path: Path) -> None:
    write_campaign(plain, tmp_path / "a.nc")
    with h5py.File(tmp_path / "a.nc") as file:
        assert file.attrs["epoch"] == plain.epoch
        assert file.attrs["earth_rotation_rate"] == plain.earth_rotation_rate
        assert file["gnss/position"].attrs["standard_deviation"].shape == (3,)
        assert file["star_tracker/quaternion"].attrs["standard_deviation"].shape == (3,)
        assert np.size(file["doppler/frequency_shift"].attrs["standard_deviation"]) == 1
        assert file["doppler/frequency_shift"].attrs["carrier_frequency"] == plain.doppler.carrier_frequency
        assert "position_standard_deviation" not in file["gnss"]
        for name, unit in {
            "gnss/time": "s",
            "gnss/position": "m",
            "star_tracker/quaternion": "1",
            "torque/command": "N m",
            "doppler/frequency_shift": "Hz",
            "doppler/beam_direction": "1",
            "arcs/start": "s",
            "nominal/inertia": "kg m2",
        }.items():
            assert file[name].attrs["units"] == unit, name
        dimensions = [[s.name.rsplit("/", 1)[-1] for s in d.values()] for d in file["doppler/beam_direction"].dims]
        assert dimensions == [["beam"], ["xyz"]]
        assert set(h5py.Dataset.asstr(file["arcs/kind"])[:]) == {"doppler", "free_rotation", "torque_pulse"}
    write_campaign(simulated, tmp_path / "b.nc")
    with h5py.File(tmp_path / "b.nc") as file:
        for name in ("gnss/position", "doppler/frequency_shift"):
            assert file[f"{name}_standard_deviation"].shape == file[name].shape
        assert "standard_deviation" not in file["gnss/position"].attrs
        assert file["star_tracker/quaternion_standard_deviation"].shape == (simulated.star_tracker.time.size, 3)


def test_another_library_reads_what_is_written(simulated: Campaign, tmp_path: Path) -> None:
    xarray = pytest.importorskip("xarray")
    write_campaign(simulated, tmp_path / "a.nc")
    with xarray.open_dataset(tmp_path / "a.nc", group="star_tracker", engine="h5netcdf") as group:
        assert group["quaternion"].dims == ("time", "wxyz")
        assert np.array_equal(group["quaternion"].values, simulated.star_tracker.quaternion)
    with xarray.open_dataset(tmp_path / "a.nc", group="arcs", engine="h5netcdf") as group:
        assert list(group["name"].values) == [arc.name for arc in simulated.arcs]


def test_what_another_library_writes_is_read(plain: Campaign, tmp_path: Path) -> None:
    """The same content written by xarray: compressed chunks, fill values, dimension names of its own choice."""
    xarray = pytest.importorskip("xarray")
    write_campaign(plain, tmp_path / "a.nc")
    groups = ["gnss", "star_tracker", "doppler", "torque", "arcs", "nominal"]
    with xarray.open_dataset(tmp_path / "a.nc", engine="h5netcdf") as root:
        xarray.Dataset(attrs=root.attrs).to_netcdf(tmp_path / "b.nc", engine="h5netcdf")
    for name in groups:
        with xarray.open_dataset(tmp_path / "a.nc", group=name, engine="h5netcdf") as group:
            group.load()
            encoding = {v: {"zlib": True, "complevel": 4} for v in group.data_vars if group[v].dtype == float}
            group.to_netcdf(tmp_path / "b.nc", mode="a", group=name, engine="h5netcdf", encoding=encoding)
    assert_same(read_campaign(tmp_path / "b.nc"), plain)


def edited(campaign: Campaign, path: Path, change: Any) -> Campaign:
    """Write, change the file, read."""
    write_campaign(campaign, path)
    with h5py.File(path, "r+") as file:
        change(file)
    return read_campaign(path)


def rewrite(file: h5py.File, name: str, values: np.ndarray) -> None:
    """Replace a variable, keeping its attributes that are not of the format's internals."""
    attributes = {
        k: v
        for k, v in file[name].attrs.items()
        if k not in ("DIMENSION_LIST", "REFERENCE_LIST", "CLASS", "NAME") and not k.startswith("_N")
    }
    del file[name]
    file.create_dataset(name, data=values)
    for key, value in attributes.items():
        file[name].attrs[key] = value


def test_stated_units_are_converted(plain: Campaign, tmp_path: Path) -> None:
    def change(file: h5py.File) -> None:
        file["gnss/position"][...] = file["gnss/position"][...] / 1e3
        file["gnss/position"].attrs["units"] = "km"
        file["gnss/position"].attrs["standard_deviation"] = plain.gnss.standard_deviation[0] / 1e3
        quaternion = file["star_tracker/quaternion"]
        quaternion.attrs["standard_deviation"] = np.rad2deg(plain.star_tracker.standard_deviation[0])
        quaternion.attrs["standard_deviation_units"] = "deg"
        file["doppler/frequency_shift"][...] = file["doppler/frequency_shift"][...] / 1e3
        file["doppler/frequency_shift"].attrs["units"] = "kHz"
        file["doppler/frequency_shift"].attrs["standard_deviation"] = plain.doppler.standard_deviation[0, 0] / 1e3
        file["star_tracker/time"][...] = file["star_tracker/time"][...] / 60
        file["star_tracker/time"].attrs["units"] = "min"

    campaign = edited(plain, tmp_path / "a.nc", change)
    assert np.allclose(campaign.gnss.position, plain.gnss.position, rtol=1e-14, atol=0)
    assert np.allclose(campaign.gnss.standard_deviation, plain.gnss.standard_deviation, rtol=1e-14)
    assert np.allclose(campaign.star_tracker.standard_deviation, plain.star_tracker.standard_deviation, rtol=1e-14)
    assert np.allclose(campaign.doppler.frequency_shift, plain.doppler.frequency_shift, rtol=1e-14)
    assert np.allclose(campaign.doppler.standard_deviation, plain.doppler.standard_deviation, rtol=1e-14)
    assert np.allclose(campaign.star_tracker.time, plain.star_tracker.time, rtol=1e-14)


def test_units_of_another_quantity_are_refused(plain: Campaign, tmp_path: Path) -> None:
    def change(file: h5py.File) -> None:
        file["gnss/position"].attrs["units"] = "deg"

    with pytest.raises(UnitError, match=r"gnss/position.*'deg'"):
        edited(plain, tmp_path / "a.nc", change)


def test_seconds_since_the_epoch_are_seconds(plain: Campaign, tmp_path: Path) -> None:
    def right(file: h5py.File) -> None:
        file["gnss/time"].attrs["units"] = "seconds since " + plain.epoch.replace("T", " ").replace("Z", "")

    assert_same(edited(plain, tmp_path / "a.nc", right), plain)

    def wrong(file: h5py.File) -> None:
        file["gnss/time"].attrs["units"] = "seconds since 1970-01-01"

    with pytest.raises(UnitError, match="another instant"):
        edited(plain, tmp_path / "b.nc", wrong)


def test_a_dimension_named_xyzw_says_that_the_scalar_stands_last(plain: Campaign, tmp_path: Path) -> None:
    def change(file: h5py.File) -> None:
        for name in ("star_tracker/quaternion", "nominal/antenna_from_tracker"):
            values = np.roll(file[name][...], -1, axis=-1)
            attributes = {
                k: file[name].attrs[k]
                for k in ("standard_deviation", "standard_deviation_units")
                if k in file[name].attrs
            }
            del file[name]
            data = file.create_dataset(name, data=values)
            scale = file.create_dataset(name.split("/")[0] + "/xyzw", data=np.zeros(4))
            scale.make_scale("xyzw")
            data.dims[values.ndim - 1].attach_scale(scale)
            data.attrs.update(attributes)

    assert_same(edited(plain, tmp_path / "a.nc", change), plain)


def test_storage_types_that_hold_the_same_numbers(plain: Campaign, tmp_path: Path) -> None:
    def change(file: h5py.File) -> None:
        kinds = np.array([a.kind for a in plain.arcs], dtype="S16")
        rewrite(file, "arcs/kind", kinds)
        names = np.array([list(a.name.ljust(16, "\0")) for a in plain.arcs], dtype="S1")
        rewrite(file, "arcs/name", names)
        millimetres = np.round(file["gnss/position"][...] * 1e3)
        rewrite(file, "gnss/position", millimetres.astype(np.int64))
        file["gnss/position"].attrs["scale_factor"] = 1e-3
        rewrite(file, "doppler/frequency_shift", file["doppler/frequency_shift"][...].astype(">f8"))

    campaign = edited(plain, tmp_path / "a.nc", change)
    assert np.abs(campaign.gnss.position - plain.gnss.position).max() <= 5.1e-4
    assert campaign.arcs == plain.arcs
    assert np.array_equal(campaign.doppler.frequency_shift, plain.doppler.frequency_shift)


def test_a_single_value_stands_for_all_axes_and_uses_no_memory(plain: Campaign, tmp_path: Path) -> None:
    def change(file: h5py.File) -> None:
        file["gnss/position"].attrs["standard_deviation"] = 2.5
        file["doppler/frequency_shift"].attrs["standard_deviation"] = np.array([1.0, 2.0, 3.0])

    campaign = edited(plain, tmp_path / "a.nc", change)
    assert campaign.gnss.standard_deviation.shape == campaign.gnss.position.shape
    assert (campaign.gnss.standard_deviation == 2.5).all()
    assert campaign.gnss.standard_deviation.strides == (0, 0)
    assert (campaign.doppler.standard_deviation == [1.0, 2.0, 3.0]).all()


def test_the_variable_stands_in_place_of_the_attribute(plain: Campaign, tmp_path: Path) -> None:
    varying = np.linspace(1.0, 4.0, plain.gnss.position.size).reshape(-1, 3)

    def change(file: h5py.File) -> None:
        file.create_dataset("gnss/position_standard_deviation", data=varying)

    assert np.array_equal(edited(plain, tmp_path / "a.nc", change).gnss.standard_deviation, varying)

    def wrong(file: h5py.File) -> None:
        file.create_dataset("gnss/position_standard_deviation", data=varying[:-1])

    with pytest.raises(ShapeError, match="position_standard_deviation"):
        edited(plain, tmp_path / "b.nc", wrong)


@pytest.mark.parametrize(
    ("name", "change", "error", "words"),
    [
        ("frame", lambda f: f["gnss/position"].attrs.__setitem__("frame", "inertial"), FileFormatError, "frame"),
        (
            "accuracy",
            lambda f: f["gnss/position"].attrs.__delitem__("standard_deviation"),
            MissingDataError,
            "accuracy",
        ),
        (
            "carrier",
            lambda f: f["doppler/frequency_shift"].attrs.__delitem__("carrier_frequency"),
            MissingDataError,
            "carrier",
        ),
        ("epoch", lambda f: f.attrs.__delitem__("epoch"), MissingDataError, "epoch"),
        ("rate", lambda f: f.attrs.__delitem__("earth_rotation_rate"), MissingDataError, "earth_rotation_rate"),
        ("variable", lambda f: f.__delitem__("gnss/position"), MissingDataError, "position"),
        ("text", lambda f: rewrite(f, "gnss/time", np.array(["a"] * 1801, dtype="S1")), FileFormatError, "numbers"),
        ("transposed", lambda f: rewrite(f, "gnss/position", f["gnss/position"][...].T), ShapeError, "gnss/position"),
        ("numbers", lambda f: rewrite(f, "arcs/kind", np.arange(11)), FileFormatError, "strings"),
        ("attribute", lambda f: f.attrs.__setitem__("earth_rotation_rate", "fast"), FileFormatError, "number"),
    ],
)
def test_files_that_are_not_of_the_format(
    name: str, change: Any, error: type[Exception], words: str, plain: Campaign, tmp_path: Path
) -> None:
    with pytest.raises(error, match=words):
        edited(plain, tmp_path / "a.nc", change)


def test_an_interrupted_write_leaves_the_old_file(
    plain: Campaign, simulated: Campaign, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    target = tmp_path / "a.nc"
    write_campaign(plain, target)
    before = target.read_bytes()

    def interrupted(*_: Any) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(campaign_file, "_write_plan", interrupted)
    with pytest.raises(KeyboardInterrupt):
        write_campaign(simulated, target)
    assert target.read_bytes() == before
    assert [p.name for p in tmp_path.iterdir()] == ["a.nc"]
    with pytest.raises(KeyboardInterrupt):
        write_campaign(simulated, tmp_path / "new.nc")
    assert not (tmp_path / "new.nc").exists()


def test_housekeeping_with_different_times_is_refused_in_writing(plain: Campaign, tmp_path: Path) -> None:
    series = {"a": Covariate(np.arange(3.0), np.zeros(3), "K"), "b": Covariate(np.arange(4.0), np.zeros(4), "A")}
    with pytest.raises(ShapeError, match="housekeeping/b"):
        write_campaign(dataclasses.replace(plain, housekeeping=series), tmp_path / "a.nc")
    assert not (tmp_path / "a.nc").exists()


def test_a_long_campaign_is_read_in_little_memory(plain: Campaign, tmp_path: Path) -> None:
    """864,000 positions take 28 MB; reading and checking them may take at most as much again."""
    time = np.linspace(0.0, 172800.0, 864000)
    rate, radius = 1.0e-3, 7.1e6
    angle = rate * time
    position = radius * np.stack([np.cos(angle), np.sin(angle) * 0.2, np.sin(angle) * np.sqrt(0.96)], axis=1)
    gnss = GnssSeries(time, position, np.broadcast_to(3.0, position.shape))
    attitude = dataclasses.replace(plain, gnss=gnss, doppler=None, torque=None, arcs=())
    write_campaign(attitude, tmp_path / "a.nc")
    read_campaign(tmp_path / "a.nc")  # what is imported at first use does not count
    tracemalloc.start()
    campaign = read_campaign(tmp_path / "a.nc")
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert np.array_equal(campaign.gnss.position, position)
    assert peak < 60e6


@pytest.mark.skipif(not DATA.is_dir(), reason=f"no measured campaigns at {DATA}")
def test_campaigns_of_another_simulator() -> None:
    files = sorted(DATA.glob("*.nc"))
    assert len(files) >= 6
    for path in files:
        campaign = read_campaign(path)
        with h5py.File(path) as file:
            assert np.array_equal(campaign.gnss.position, file["gnss/position"][...])
            assert np.array_equal(campaign.doppler.frequency_shift, file["doppler/frequency_shift"][...])
            rotation = np.abs(np.sum(campaign.star_tracker.quaternion * file["star_tracker/quaternion"][...], axis=1))
            assert np.abs(rotation - 1).max() < 1e-12
        assert len(campaign.arcs) == 18
        assert campaign.doppler.carrier_frequency == 9.6e9
