"""OpenStreetMap from the net, through osmnx: the signs and roads of a place or a box, kept in a folder.

What a server answered is asked for once. Environment variables name other servers and another folder:
`GEOFLEET_OVERPASS_URL`, `GEOFLEET_NOMINATIM_URL`, `GEOFLEET_CACHE`.
"""

from __future__ import annotations

import hashlib
import json
import os
import re
import socket
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from geofleet.errors import ConfigError, InputError
from geofleet.formats.osm_tags import CAR_ROADS, POINT_HIGHWAYS
from geofleet.tables.store import atomic_path

if TYPE_CHECKING:
    from collections.abc import Iterator

    Box = tuple[float, float, float, float]

_ASKED: dict[str, bool | str | list[str]] = {"traffic_sign": True, "highway": sorted({*CAR_ROADS, *POINT_HIGHWAYS})}
_SERVERS = {"overpass_url": "GEOFLEET_OVERPASS_URL", "nominatim_url": "GEOFLEET_NOMINATIM_URL"}


def cache_folder() -> Path:
    """Return where answers are kept: `GEOFLEET_CACHE`, or the user's cache folder."""
    given = os.environ.get("GEOFLEET_CACHE")
    base = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    return Path(given) if given else Path(base) / "geofleet"


def fetch(*, place: str | None = None, bbox: Box | None = None, cache: Path | None = None) -> Path:
    """Return a file with the signs and drivable roads of a place or a box, fetched when it is not there yet.

    Parameters
    ----------
    place
        What Nominatim finds as an area: "Compiègne, France".
    bbox
        West, south, east, north, degrees.
    cache
        Folder to keep answers in; `cache_folder()` by default.

    Raises
    ------
    ConfigError
        Neither or both of place and box are given, or the box is none.
    InputError
        The servers cannot be reached, know no such place, or have nothing there.
    """
    if (place is None) == (bbox is None):
        raise ConfigError("either a place or a box is needed.", where="--place, --bbox")
    if bbox is not None:
        _check_box(bbox)
    wanted = place or ",".join(f"{side:g}" for side in bbox or ())
    folder = cache or cache_folder()
    path = folder / f"{_slug(wanted)}.osm.json"
    if path.is_file():
        return path
    found = _elements(wanted, bbox, folder)
    with atomic_path(path) as draft:
        draft.write_text(json.dumps({"generator": "Overpass API through osmnx", "elements": found}), encoding="utf-8")
    return path


def parse_bbox(text: str) -> Box:
    """Read `W,S,E,N`.

    Raises
    ------
    ConfigError
        The text is not four numbers, or they are no box.
    """
    try:
        west, south, east, north = map(float, text.split(","))
    except ValueError:
        raise ConfigError(
            f"{text!r} is not W,S,E,N.", where="--bbox", todo="Example: --bbox 24.93,60.16,24.96,60.18"
        ) from None
    _check_box((west, south, east, north))
    return west, south, east, north


def _check_box(box: Box) -> None:
    west, south, east, north = box
    if not (-180 <= west < east <= 180 and -90 <= south < north <= 90):  # noqa: PLR2004 - degrees
        raise ConfigError(
            f"{box} is no box of degrees, west before east and south before north.",
            where="--bbox",
            todo="Example: --bbox 24.93,60.16,24.96,60.18",
        )


def _slug(text: str) -> str:
    """Return a file name for what was asked: readable, and different for different texts."""
    readable = re.sub(r"[^\w.]+", "-", text).strip("-").lower()[:60]
    return f"{readable}-{hashlib.sha256(text.encode()).hexdigest()[:8]}"


def _elements(wanted: str, bbox: Box | None, folder: Path) -> list[dict[str, Any]]:
    import osmnx  # noqa: PLC0415  (takes two seconds to load)

    try:
        with _osmnx_settings(osmnx.settings, folder):
            if bbox is None:
                frame = osmnx.features_from_place(wanted, _ASKED)
            else:
                frame = osmnx.features_from_bbox(bbox, _ASKED)
    except osmnx._errors.InsufficientResponseError as error:  # noqa: SLF001 - osmnx names its errors nowhere else
        raise InputError(
            f"OpenStreetMap has nothing for {wanted!r} ({str(error).rstrip('.')}).", todo="Check the name or the box."
        ) from None
    except (OSError, ValueError, TypeError) as error:
        reason = str(error).splitlines()[0][:200] if str(error) else type(error).__name__
        raise InputError(
            f"OpenStreetMap cannot be asked for {wanted!r}: no connection, or no answer ({reason}).",
            todo="Check the connection, or give a file instead: an extract .osm.pbf, or an Overpass answer .json.",
        ) from None
    return [element for row in frame.sort_index().iterrows() if (element := _element(*row))]


@contextmanager
def _osmnx_settings(settings: Any, folder: Path) -> Iterator[None]:
    """Set osmnx up for one request, and leave it, and the socket that it bends, as they were."""
    chosen: dict[str, Any] = {"cache_folder": str(folder / "osmnx"), "use_cache": True, "doh_url_template": None}
    chosen |= {name: os.environ[key] for name, key in _SERVERS.items() if os.environ.get(key)}
    if "overpass_url" in chosen:
        chosen["overpass_rate_limit"] = False  # one's own server has no queue to ask about
    before = {name: getattr(settings, name) for name in chosen}
    resolve = socket.getaddrinfo
    for name, value in chosen.items():
        setattr(settings, name, value)
    try:
        yield
    finally:
        socket.getaddrinfo = resolve
        for name, value in before.items():
            setattr(settings, name, value)


def _element(key: tuple[str, int], row: Any) -> dict[str, Any] | None:
    """Return a feature as Overpass writes it with `out geom`; areas and relations carry no signs."""
    kind, number = key
    shape = row["geometry"]
    tags = {name: value for name, value in row.items() if name != "geometry" and isinstance(value, str)}
    if kind == "node":
        return {"type": kind, "id": int(number), "lon": shape.x, "lat": shape.y, "tags": tags}
    if kind == "way" and shape.geom_type in {"LineString", "Polygon"}:
        line = shape if shape.geom_type == "LineString" else shape.exterior
        return {
            "type": kind,
            "id": int(number),
            "geometry": [{"lon": lon, "lat": lat} for lon, lat in line.coords],
            "tags": tags,
        }
    return None
