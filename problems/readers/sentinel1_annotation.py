"""Sentinel-1 product annotations (the XML file of one sub-swath and polarisation), read safely.

What the alignment needs of them: orbit and attitude, and the estimates of the Doppler centroid, both predicted from
orbit and attitude (geometry) and measured from the radar data. Tried with processor outputs from 2014 to 2025, of the
missions A and B; the annotation itself does not say which processor version wrote it.

Conventions of the product, checked against its own geometry Doppler: the quaternion components q0, q1, q2 are the
vector part and q3 is the scalar; they turn body coordinates into the mean equator and equinox of J2000. Body y points
against the velocity; the antenna looks along body -z, about 30 degrees from nadir; the line of sight lies in the body
x-z plane. The telemetered rates (wx, wy, wz) are the body rates (-w_y, -w_x, -w_z) and are not used.
"""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from estimator.models.errors import FileFormatError, MissingDataError, QuaternionError
from problems.readers.sentinel1_orbit_file import StateVectors, number, times, xml_root


@dataclass(frozen=True)
class AttitudeVectors:
    """Attitude of the spacecraft.

    Attributes:
        time: (n,) datetime64[us], TAI, strictly increasing.
        celestial_from_body: (n, 4) unit quaternions, scalar first, of continuous sign.
    """

    time: np.ndarray
    celestial_from_body: np.ndarray


@dataclass(frozen=True)
class DopplerEstimate:
    """One estimate of the Doppler centroid along slant range.

    Polynomials have the coefficients of ascending powers of the two-way slant range time minus ``reference``, in
    Hz, Hz/s, ...

    Attributes:
        time: datetime64[us], TAI, zero-Doppler azimuth time.
        reference: s, two-way slant range time t0.
        geometry: coefficients predicted from orbit and attitude; empty where the product has none.
        measured: coefficients fitted to the radar data; empty where the product has none.
        rms: Hz, of the data about the fit.
        trusted: False where the product says that the RMS exceeds its threshold.
        fine_slant_time: (k,) s, two-way slant range times of the fine estimates.
        fine_frequency: (k,) Hz, the fine estimates.
    """

    time: np.datetime64
    reference: float
    geometry: np.ndarray
    measured: np.ndarray
    rms: float
    trusted: bool
    fine_slant_time: np.ndarray
    fine_frequency: np.ndarray


@dataclass(frozen=True)
class Annotation:
    """What the annotation of one sub-swath says.

    Attributes:
        path: where it was read.
        mission: ``S1A``, ``S1B``, ``S1C``, ...
        product_type, mode, swath, polarisation: as the product says (``SLC``, ``IW``, ``IW1``, ``VV``).
        data_take: number of the data take.
        start, stop: datetime64[us], TAI, first and last line.
        processor_version: of the processor; empty where the file does not say.
        radar_frequency: Hz.
        range_sampling_rate: Hz.
        slant_range_time: s, two-way, of the first range sample.
        samples: number of range samples of an image line.
        orbit_from_file: the processor used an orbit file and not the orbit of the downlink.
        orbit: Earth-fixed state vectors.
        attitude: attitude of the body axes.
        estimates: Doppler estimates in order of time.
        terrain_time, terrain_height: datetime64[us] TAI and m, mean height of the scene along time; may be empty.
    """

    path: Path
    mission: str
    product_type: str
    mode: str
    swath: str
    polarisation: str
    data_take: str
    start: np.datetime64
    stop: np.datetime64
    processor_version: str
    radar_frequency: float
    range_sampling_rate: float
    slant_range_time: float
    samples: int
    orbit_from_file: bool
    orbit: StateVectors
    attitude: AttitudeVectors
    estimates: tuple[DopplerEstimate, ...]
    terrain_time: np.ndarray
    terrain_height: np.ndarray


def read_annotation(path: str | os.PathLike[str]) -> Annotation:
    """Read an annotation file.

    Args:
        path: the XML file of one sub-swath and polarisation.

    Raises:
        FileFormatError: no XML, XML with entities, not a product annotation, another frame, text that is no number.
        MissingDataError: an element or list that the alignment needs is missing or empty.
        NotFiniteError: NaN or infinity.
        QuaternionError: an attitude that is no rotation.
    """
    path = Path(path)
    root = xml_root(path)
    header = root.find("adsHeader")
    if root.tag != "product" or header is None:
        raise FileFormatError(
            "this is no Sentinel-1 product annotation",
            where=str(path),
            value=f"root element {root.tag!r}",
            limit="'product' with 'adsHeader'",
            remedy="take the files from the folder 'annotation' of the product, not 'calibration' or 'rfi'",
        )
    name = path.name

    def text(element: str) -> str:
        return (header.findtext(element) or "").strip()

    def value(element: str) -> float:
        return number(root.findtext(f".//{element}"), f"{name}: {element}")

    limits = times([header.findtext("startTime"), header.findtext("stopTime")], f"{name}: adsHeader")
    terrain = [e for e in root.findall(".//terrainHeightList/terrainHeight") if e.find("value") is not None]
    samples = root.findtext(".//imageInformation/numberOfSamples")
    return Annotation(
        path=path,
        mission=text("missionId"),
        product_type=text("productType"),
        mode=text("mode"),
        swath=text("swath"),
        polarisation=text("polarisation"),
        data_take=text("missionDataTakeId"),
        start=limits[0],
        stop=limits[1],
        processor_version=(root.findtext(".//softwareVersion") or "").strip(),
        radar_frequency=value("radarFrequency"),
        range_sampling_rate=value("rangeSamplingRate"),
        slant_range_time=value("imageInformation/slantRangeTime"),
        samples=int(samples) if samples else 0,
        orbit_from_file=(root.findtext(".//orbitDataFileUsed") or "true").strip().lower() == "true",
        orbit=_orbit(root, name),
        attitude=_attitude(root, name),
        estimates=_estimates(root, name),
        terrain_time=times([e.findtext("azimuthTime") for e in terrain], f"{name}: terrainHeight"),
        terrain_height=np.array([number(e.findtext("value"), f"{name}: terrainHeight") for e in terrain]),
    )


def _list(root: Any, path: str, name: str, frame: str | None) -> list[Any]:
    """The elements of a list that must not be empty, all in one frame."""
    elements = root.findall(f".//{path}")
    if not elements:
        raise MissingDataError(
            f"the list {path!r} is missing or empty", where=name, remedy="use a product whose annotation carries it"
        )
    if frame is not None:
        other = {(e.findtext("frame") or frame).strip() for e in elements} - {frame}
        if other:
            raise FileFormatError(
                "the list is given in another frame",
                where=f"{name}: {path}",
                value=", ".join(sorted(other)),
                limit=frame,
            )
    return list(elements)


def _orbit(root: Any, name: str) -> StateVectors:
    elements = _list(root, "orbitList/orbit", name, "Earth Fixed")
    where = f"{name}: orbit"
    time = times([e.findtext("time") for e in elements], where)
    position = np.array([[number(e.findtext(f"position/{axis}"), where) for axis in "xyz"] for e in elements])
    velocity = np.array([[number(e.findtext(f"velocity/{axis}"), where) for axis in "xyz"] for e in elements])
    _, order = np.unique(time, return_index=True)
    return StateVectors(time[order], position[order], velocity[order])


def _attitude(root: Any, name: str) -> AttitudeVectors:
    elements = _list(root, "attitudeList/attitude", name, "GM2000")
    where = f"{name}: attitude"
    time = times([e.findtext("time") for e in elements], where)
    quaternion = np.array([[number(e.findtext(f"q{k}"), where) for k in (3, 0, 1, 2)] for e in elements])
    length = np.linalg.norm(quaternion, axis=1)
    if np.abs(length - 1).max() > 1e-3:  # seven digits are printed; more than that is damage
        k = int(np.argmax(np.abs(length - 1)))
        raise QuaternionError(
            "the quaternion is not of unit length",
            where=f"{where}[{k}]",
            value=f"{length[k]:.6g}",
            limit="1 within 0.001",
        )
    _, order = np.unique(time, return_index=True)
    quaternion = (quaternion / length[:, None])[order]
    flips = np.einsum("ij,ij->i", quaternion[1:], quaternion[:-1]) < 0
    sign = np.concatenate([[1.0], np.where(np.cumsum(flips) % 2 == 1, -1.0, 1.0)])
    return AttitudeVectors(time[order], quaternion * sign[:, None])


def _polynomial(element: Any, name: str, where: str) -> np.ndarray:
    text = element.findtext(name) or ""
    return np.array([number(word, f"{where}: {name}") for word in text.split()])


def _estimates(root: Any, name: str) -> tuple[DopplerEstimate, ...]:
    elements = _list(root, "dcEstimateList/dcEstimate", name, None)
    where = f"{name}: dcEstimate"
    time = times([e.findtext("azimuthTime") for e in elements], where)
    found = []
    for k, element in enumerate(elements):
        fine = element.findall("fineDceList/fineDce")
        found.append(
            DopplerEstimate(
                time=time[k],
                reference=number(element.findtext("t0"), f"{where}[{k}]: t0"),
                geometry=_polynomial(element, "geometryDcPolynomial", f"{where}[{k}]"),
                measured=_polynomial(element, "dataDcPolynomial", f"{where}[{k}]"),
                rms=number(element.findtext("dataDcRmsError") or "0", f"{where}[{k}]: dataDcRmsError"),
                trusted=(element.findtext("dataDcRmsErrorAboveThreshold") or "false").strip().lower() != "true",
                fine_slant_time=np.array(
                    [number(f.findtext("slantRangeTime"), f"{where}[{k}]: fineDce") for f in fine]
                ),
                fine_frequency=np.array([number(f.findtext("frequency"), f"{where}[{k}]: fineDce") for f in fine]),
            )
        )
    return tuple(sorted(found, key=lambda estimate: estimate.time))
