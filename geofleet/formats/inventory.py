"""Sign inventories of cities, road agencies and Mapillary, and geofleet's own layers in a GIS format.

Codes are read by OpenStreetMap's grammar where the column is its `traffic_sign`, as classes of Mapillary where they
look like it, else as codes of a country's scheme. What is not given is guessed, and each guess is told in `found`.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from geofleet.errors import ConfigError, InputError
from geofleet.formats.datum import datum_of
from geofleet.formats.inventory_codes import OSM, guess_country, is_osm, plain_codes, read_codes, read_osm, scheme_of
from geofleet.formats.inventory_columns import choose_columns, numbers, parse_facings, parse_times, read_options, texts
from geofleet.formats.inventory_files import detect, read_features
from geofleet.formats.inventory_layer import is_own_layer, own_lanes, own_layer
from geofleet.formats.inventory_places import Places, place_features
from geofleet.formats.positions import area_doubt, country_at, doubts
from geofleet.formats.reading import LayerRead
from geofleet.formats.xml import explained
from geofleet.tables.schemas import SIGNS
from geofleet.tables.store import build_table

if TYPE_CHECKING:
    from collections.abc import Sequence

    import pyarrow as pa

    from geofleet.formats.inventory_codes import Plates
    from geofleet.formats.inventory_columns import InventoryColumns
    from geofleet.formats.inventory_files import Features

__all__ = ["detect", "read_lanes", "read_signs"]

FORMAT = "inventory"
OPTIONS = frozenset({"crs", "scheme", "country", "separator", "day_first", "layer", "encoding", "delimiter", "swap_xy"})
_TEXTS = tuple(column.name for column in SIGNS.columns if not column.nullable)
_NO_PLACES = (np.zeros(0), np.zeros(0))
_OSM_STARTS = ("traffic_sign", "maxspeed", "road_marking")
_OSM_KEYS = ("direction", "highway", "city_limit", "traffic_signals:direction")


def read_signs(path: Path, *, columns: Mapping[str, str] | Path | None = None, **options: Any) -> LayerRead:
    """Read a sign inventory.

    Parameters
    ----------
    path
        GeoJSON, GeoPackage, Shapefile or a zip of one, FlatGeobuf, GeoParquet, Parquet or CSV.
    columns
        What a column means, as in `InventoryColumns` (`{"code": "bord", "facing": "azimuth"}`), or a TOML file with a
        table `columns` of that kind and any of the options below beside it. Columns not named are guessed.
    crs
        CRS of the coordinates; overrides what the file says. Without either it is OGC:CRS84.
    scheme
        `mapillary`, `osm`, `vienna` or a national scheme of the taxonomy, for every code.
    country
        ISO 3166-1 alpha-2 of the codes, where they do not name it.
    separator
        What stands between the codes of a stack; by default `|`, `;` and ` + ` do.
    day_first
        Whether 1/2/2022 is in February; by default what the other dates show.
    layer, encoding, delimiter
        As in `inventory_files.read_features`.
    swap_xy
        The file gives latitude before longitude.

    Returns
    -------
    LayerRead
        One row a plate; plates of one feature have its `support_id`. A code on a line or an area says where it applies
        and not where a sign stands: such a row is of kind other, on the middle of the line or within the area. Equal
        plates at one point stay as many rows as the file has. A feature without a code is of concept `unspecified`,
        or none at all where the column is OpenStreetMap's.

    Raises
    ------
    InputError
        The file is missing, empty, damaged or of another format, no column holds codes, the CRS is
        unknown, or the positions contradict it or the country.
    ConfigError
        An option or a column given is unknown.
    """
    named, options = _settled(columns, options)
    with explained(path):
        features = read_features(path, **{k: options[k] for k in ("layer", "encoding", "delimiter") if k in options})
        if is_own_layer(features.table):
            return own_layer(path, features, options.get("crs"))
        return _read(path, features, named, options)


def read_lanes(path: Path) -> LayerRead:
    """Read roads and lanes back that geofleet wrote as GeoJSON, GeoPackage or FlatGeobuf.

    Raises
    ------
    InputError
        The file is missing, damaged or of another format, or holds something else.
    """
    with explained(path):
        return own_lanes(path, read_features(path))


def _read(path: Path, features: Features, named: Mapping[str, str], options: Mapping[str, Any]) -> LayerRead:
    """Return the signs of the rows of a file."""
    if not features.table.num_rows and features.skipped:
        reasons = ", ".join(f"{n} {reason}" for reason, n in features.skipped.items())
        raise InputError(f"no row can be read ({reasons}).", where=str(path), todo="Quote what holds the separator.")
    if not features.table.num_rows and not named:
        return LayerRead(build_table(SIGNS, {name: [] for name in _TEXTS}, _NO_PLACES), features.file_format)
    chosen, guessed = choose_columns(features.table.column_names, named, has_geometry=features.geometry is not None)
    if not chosen.code:
        raise _no_code(path, features.table.column_names)
    places = place_features(path, features, chosen, crs=options.get("crs"), swap_xy=bool(options.get("swap_xy")))
    if features.table.num_rows and not len(places.feature):
        reasons = ", ".join(f"{n} {reason}" for reason, n in places.skipped.items())
        raise InputError(
            f"none of {features.table.num_rows} rows has a position that can be used ({reasons}).",
            where=str(path),
            todo="Give degrees or metres as plain numbers, and name columns and CRS: --columns x=…,y=… --crs …",
        )
    table = features.table.take(places.feature)
    plates, told = _plates(table, chosen, places, options)
    found = features.found | places.found | told
    found |= {
        f"{thing} read from column {getattr(chosen, thing)} (guessed)": features.table.num_rows for thing in guessed
    }
    found |= doubts(places.lon, places.lat, plates.main_country(), where=str(path))
    found |= area_doubt(places.crs, places.lon, places.lat)
    signs, doubtful = _signs(path, table, chosen, places, plates, day_first=options.get("day_first"))
    skipped = Counter(features.skipped) + Counter(places.skipped) + Counter(plates.skipped)
    told_all = {reason: count for reason, count in (found | doubtful).items() if count}
    datum = datum_of(places.crs, places.lon, places.lat)
    return LayerRead(signs, features.file_format, dict(skipped), told_all, datum)


def _no_code(path: Path, names: Sequence[str]) -> InputError:
    if not names:
        return InputError(
            "geometries without any attribute, so without the code of a sign.",
            where=str(path),
            todo="Export it with its attributes; those of a Shapefile are in a .dbf beside it.",
        )
    return InputError(
        f"no column looks like the code of a sign; there are {', '.join(names)[:300]}.",
        where=str(path),
        todo="Name it: --columns code=…. If it holds no signs, say what it is: info --table drives.",
    )


def _settled(
    columns: Mapping[str, str] | Path | None, options: dict[str, Any]
) -> tuple[dict[str, str], dict[str, Any]]:
    """Return columns and options, those of a TOML file under those given."""
    named: Any = columns or {}
    if isinstance(columns, Path):
        options = read_options(columns) | {name: value for name, value in options.items() if value is not None}
        named = options.pop("columns", {})
    unknown = sorted(set(options) - OPTIONS)
    if unknown:
        raise ConfigError(f"unknown option {', '.join(unknown)}.", todo=f"Options are {', '.join(sorted(OPTIONS))}.")
    if not isinstance(named, Mapping) or not all(isinstance(name, str) for name in named.values()):
        raise ConfigError("the columns are no table of names.", todo='Write [columns] and below it code = "…".')
    return dict(named), options


def _plates(
    table: pa.Table, chosen: InventoryColumns, places: Places, options: Mapping[str, Any]
) -> tuple[Plates, dict[str, int]]:
    """Return the plates of every point, and what was guessed about their codes."""
    codes = plain_codes(texts(table, chosen.code))
    country, scheme = options.get("country"), options.get("scheme")
    if scheme == OSM or (scheme is None and is_osm(chosen.code, codes, country)):
        return read_osm(_osm_tags(table, chosen), country), {}
    scheme = scheme or scheme_of(codes)
    found = {}
    if not (scheme or country or chosen.country) and len(places.lon):
        here = country_at(float(np.median(places.lon)), float(np.median(places.lat)))
        country = guess_country(codes, here)
        found = {f"country {country} (guessed from codes and place)": len(codes)} if country else {}
    countries = [own.upper() if own else country for own in texts(table, chosen.country)]
    values = texts(table, chosen.value)
    plates = read_codes(codes, values, countries, scheme=scheme, separator=options.get("separator"))
    return plates, found | {"signs without a code": sum(not code for code in codes)}


def _osm_tags(table: pa.Table, chosen: InventoryColumns) -> list[dict[str, str]]:
    """Return the tags of every row that say something about its signs."""
    names = [n for n in table.column_names if n.startswith(_OSM_STARTS) or n in _OSM_KEYS]
    columns = {name: texts(table, name) for name in names} | {"traffic_sign": texts(table, chosen.code)}
    rows = zip(*columns.values(), strict=True)
    return [{name: value for name, value in zip(columns, row, strict=True) if value} for row in rows]


def _signs(
    path: Path,
    table: pa.Table,
    chosen: InventoryColumns,
    places: Places,
    plates: Plates,
    *,
    day_first: bool | None,
) -> tuple[pa.Table, dict[str, int]]:
    """Return the `signs` table, and what of facings and dates could not be read."""
    at = np.repeat(np.arange(table.num_rows), [len(one) for one in plates.of_feature])
    rows = [plate for one in plates.of_feature for plate in one]
    facing_text = texts(table, chosen.facing)
    facing, n_bad = parse_facings([facing_text[i] for i in at])
    stated = np.array([np.nan if plate.facing_deg is None else plate.facing_deg for plate in rows], np.float64)
    names = _names(texts(table, chosen.sign_id), places.feature)
    ids = _unique([names[i] for i in at])
    base = np.concatenate(([0], np.cumsum([len(one) for one in plates.of_feature]))).astype(np.int64)
    poles = texts(table, chosen.support)
    first, bad_first = _times(table, chosen.first_seen, day_first=day_first)
    last, bad_last = _times(table, chosen.last_seen, day_first=day_first)
    columns: dict[str, Any] = {
        "sign_id": ids,
        "kind": ["other" if places.is_extended[i] else plate.kind for i, plate in zip(at, rows, strict=True)],
        "parent_id": [None if p.parent is None else ids[base[i] + p.parent] for i, p in zip(at, rows, strict=True)],
        "concept": [plate.meaning.concept for plate in rows],
        "value": [plate.meaning.value for plate in rows],
        "unit": [plate.meaning.unit for plate in rows],
        "sign_class": [plate.meaning.sign_class for plate in rows],
        "raw_code": [plate.raw_code for plate in rows],
        "country": [plate.country for plate in rows],
        "facing_deg": np.where(np.isnan(stated), facing, stated),
        "height_m": numbers(table, chosen.height)[at],
        "support_id": [poles[i] or (names[i] if len(plates.of_feature[i]) > 1 else None) for i in at],
        "source": path.name,
        "source_ref": [names[i] for i in at],
        "first_seen": [first[i] for i in at],
        "last_seen": [last[i] for i in at],
    }
    signs = build_table(SIGNS, columns, (places.lon[at], places.lat[at]))
    told = {"facings that cannot be read": n_bad, **bad_first}
    told["signs tagged on a line or an area (kind other)"] = int(places.is_extended[at].sum())
    told |= {reason: count + bad_first.get(reason, 0) for reason, count in bad_last.items()}
    return signs, told | {"unknown codes": sum(not plate.meaning.known for plate in rows)}


def _times(table: pa.Table, name: str, *, day_first: bool | None) -> tuple[Sequence[Any], dict[str, int]]:
    return parse_times(table[name], day_first=day_first) if name else ([None] * table.num_rows, {})


def _names(given: Sequence[str | None], feature: Any) -> list[str]:
    """Return the id of each feature, `row/<number>`, counted from 1, where the file has none."""
    return [name or f"row/{row + 1}" for name, row in zip(given, feature.tolist(), strict=True)]


def _unique(names: Sequence[str]) -> list[str]:
    """Return names told apart: the second of equal ones gets `-2`, or the next number that is free."""
    taken, seen = set(names), Counter[str]()
    found = []
    for name in names:
        seen[name] += 1
        unique = name
        while seen[name] > 1 and unique in taken:
            unique = f"{name}-{seen[name]}"
            seen[name] += unique in taken
        taken.add(unique)
        found.append(unique)
    return found
