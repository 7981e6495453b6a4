"""Positions that pictures carry (EXIF), and how they place a model of structure from motion: size, up and north."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from semantic_mapper.errors import ImportSourceError
from semantic_mapper.geometry import align_similar
from semantic_mapper.plain_text import counted
from semantic_mapper.types import Float64

MIN_POSITIONS = 4
TRIALS = 300  # of three pictures each; the one with the least median error begins the fit
INLIERS = 2.5  # pictures further off than this many standard deviations do not count
ALWAYS_M = 1.0  # pictures that are no further off count in any case
MIN_FOR_OUTLIERS = 8  # of fewer pictures all count
MAX_ERROR = 0.2  # median error, as a fraction of how far the positions are spread (rms)
MIN_WIDTH = 0.05  # of what the pictures cover, as a fraction of its length: on a line nothing tells the roll
ORIGIN_KEY = "origin"  # of a log's metadata: latitude, longitude, altitude of the world's origin
_GPS = 0x8825  # EXIF's directory, and what it holds
_LATITUDE, _LONGITUDE, _BELOW_SEA, _ALTITUDE = (1, 2), (3, 4), 5, 6
_RADIUS_M, _FLATTENING = 6378137.0, 1 / 298.257223563  # WGS 84


@dataclass(frozen=True, slots=True)
class GpsPosition:
    """Degrees north and east, metres up."""

    latitude: float
    longitude: float
    altitude_m: float

    def __str__(self) -> str:
        """As logs keep it."""
        return f"{self.latitude:.7f}, {self.longitude:.7f}, {self.altitude_m:.2f} m"


@dataclass(frozen=True, slots=True, eq=False)
class GpsFit:
    """How a model lies on the Earth: ``T_world_model @ (scale * p)``; the world has x east, y north, z up."""

    T_world_model: Float64  # (4, 4)
    scale: float  # metres per unit of the model
    origin: GpsPosition  # of the world: the first picture's position
    pictures: int  # that it was fitted to
    error_m: float  # their median distance from where they say they are

    def moved(self, T_model_camera: Float64) -> Float64:
        """A pose (4, 4) in the world."""
        pose = T_model_camera.copy()
        pose[:3, 3] *= self.scale
        return self.T_world_model @ pose

    def __str__(self) -> str:
        """For people."""
        return f"GPS of {counted(self.pictures, 'picture')}, {self.error_m:.2f} m off (median)"


def read_exif(file: Path, directory: int) -> dict[int, Any]:
    """A directory of the EXIF data of a picture; empty without."""
    try:
        with Image.open(file) as image:
            return image.getexif().get_ifd(directory)
    except (OSError, ValueError, SyntaxError):
        return {}


def read_position(file: Path) -> GpsPosition | None:
    """Where a picture was taken by its EXIF data; None where these lack latitude, longitude or altitude."""
    found = read_exif(file, _GPS)
    try:
        latitude, longitude = (_degrees(found[at], str(found.get(sign, ""))) for sign, at in (_LATITUDE, _LONGITUDE))
        altitude = float(found[_ALTITUDE])
    except (ValueError, KeyError, TypeError, ZeroDivisionError):
        return None
    fixed = latitude or longitude  # 0, 0 is a receiver without a fix
    if not (fixed and abs(latitude) <= 90 and abs(longitude) <= 180 and abs(altitude) < 1e5):
        return None
    return GpsPosition(latitude, longitude, -altitude if found.get(_BELOW_SEA) in (1, b"\x01") else altitude)


def _degrees(parts: Iterable[float], sign: str) -> float:
    degrees, minutes, seconds = (float(part) for part in parts)
    return (degrees + minutes / 60 + seconds / 3600) * (-1 if sign[:1].upper() in ("S", "W") else 1)


def east_north_up(positions: Sequence[GpsPosition], origin: GpsPosition) -> Float64:
    """(N, 3) metres east, north and up of an origin."""
    lat, lon = np.radians(origin.latitude), np.radians(origin.longitude)
    east = (-np.sin(lon), np.cos(lon), 0.0)
    north = (-np.sin(lat) * np.cos(lon), -np.sin(lat) * np.sin(lon), np.cos(lat))
    up = (np.cos(lat) * np.cos(lon), np.cos(lat) * np.sin(lon), np.sin(lat))
    return (_earth_centred(positions) - _earth_centred([origin])) @ np.array((east, north, up)).T


def _earth_centred(positions: Sequence[GpsPosition]) -> Float64:
    lat, lon, h = np.array([(np.radians(p.latitude), np.radians(p.longitude), p.altitude_m) for p in positions]).T
    squeeze = _FLATTENING * (2 - _FLATTENING)
    n = _RADIUS_M / np.sqrt(1 - squeeze * np.sin(lat) ** 2)
    flat = (n + h) * np.cos(lat)
    return np.stack((flat * np.cos(lon), flat * np.sin(lon), (n * (1 - squeeze) + h) * np.sin(lat)), axis=1)


def place_by_gps(T_model_camera: Float64, positions: Sequence[GpsPosition | None]) -> GpsFit | None:
    """The similarity that takes a model of poses (N, 4, 4) to where its pictures say they are; single wrong positions
    do not count. None where no picture has one.

    Raises ImportSourceError: too few have one, they lie on a line, or they contradict the pictures.
    """
    rows = [n for n, position in enumerate(positions) if position is not None]
    known = [position for position in positions if position is not None]
    if not known:
        return None
    if len(known) < MIN_POSITIONS:
        raise ImportSourceError(
            f"{len(known)} of {counted(len(positions), 'picture')} have a GPS position with altitude, "
            f"{MIN_POSITIONS} needed"
        )
    centers, truth = T_model_camera[rows, :3, 3], east_north_up(known, known[0])
    spread_m = float(np.sqrt(((truth - truth.mean(axis=0)) ** 2).sum(axis=1).mean()))
    if not (spread_m > 0 and np.ptp(centers, axis=0).any()):
        raise ImportSourceError("the GPS positions are one and the same")
    inside = _consensus(centers, truth)
    length, width, _ = np.linalg.svd(centers[inside] - centers[inside].mean(axis=0), compute_uv=False)
    if width <= MIN_WIDTH * length:
        raise ImportSourceError("pictures that fit GPS lie on a line, about which it tells no roll; take some off it")
    T, scale = align_similar(centers[inside], truth[inside])
    error_m = float(np.median(_errors(T, scale, centers, truth)))
    if error_m > MAX_ERROR * spread_m:
        raise ImportSourceError(
            f"the GPS positions are {error_m:.1f} m off (median) within a spread of {spread_m:.1f} m, too much to tell "
            "the scale; they need a longer path, or a better receiver"
        )
    return GpsFit(T, scale, known[0], int(inside.sum()), error_m)


def _errors(T: Float64, scale: float, a: Float64, b: Float64) -> Float64:
    return np.linalg.norm(scale * a @ T[:3, :3].T + T[:3, 3] - b, axis=1)


def _consensus(a: Float64, b: Float64) -> np.ndarray:
    """Which points (N, 3) agree with the similarity that has the least median error."""
    rng, best, least = np.random.default_rng(0), np.ones(len(a), bool), np.inf
    if len(a) < MIN_FOR_OUTLIERS:
        return best
    rank = (len(a) + 3) // 2  # three points always agree
    for chosen in [np.arange(len(a)), *(rng.choice(len(a), 3, replace=False) for _ in range(TRIALS))]:
        if np.ptp(a[chosen], axis=0).max() == 0:
            continue
        errors = _errors(*align_similar(a[chosen], b[chosen]), a, b)
        middle = float(np.sort(errors)[rank - 1])
        if middle < least:
            least, best = middle, errors <= max(INLIERS * 1.4826 * middle, ALWAYS_M)
    return best
