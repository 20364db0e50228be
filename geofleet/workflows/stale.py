"""An outdated copy of a layer of signs, for priors and for studies of change. It is simulated, and says so."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from geofleet.algorithms.staleness import (
    FATES,
    OBSOLETE,
    REMOVED,
    Staleness,
    StaleSigns,
    distance_m,
    make_stale,
    sign_keys,
)
from geofleet.errors import ConfigError, InputError
from geofleet.formats.layers import read_layer
from geofleet.formats.results import write_csv
from geofleet.tables.schemas import BBOX, GEOMETRY, SIGNS
from geofleet.tables.store import atomic_path, build_table, lonlat
from geofleet.workflows.convert import layer_writer

if TYPE_CHECKING:
    from pathlib import Path

    from numpy.typing import NDArray

    Floats = NDArray[np.float64]
    Ints = NDArray[np.int64]
    Flags = NDArray[np.bool_]

_OF_A_CLASS = ("concept", "value", "unit", "sign_class", "raw_code")
_OF_A_RUN = ("run_id", "method", "n_vehicles", "change", "map_version")


@dataclass(frozen=True, slots=True)
class StaleResult:
    """What an outdated copy holds.

    Parameters
    ----------
    out
        The layer written.
    changes
        What was done to which main sign: for evaluation only, no method may read it.
    n_signs
        Rows written.
    n_main
        Main signs of the layer given: shares are of these.
    fates
        How many of them were kept, removed, retyped and moved, and how many obsolete signs were added.
    """

    out: Path
    changes: Path
    n_signs: int
    n_main: int
    fates: dict[str, int]


def stale(source: Path, out: Path, how: Staleness, *, seed: int = 0, **options: Any) -> StaleResult:
    """Write an outdated copy of a layer, and what is outdated in it to `<stem>_changes.csv` beside it.

    Main signs meet their fates; plates go with their main sign, and everything else only shares the position error. The
    variance of a position grows by `sigma_m` squared. Runs of a `reference` table share their signs, so the copy
    belongs to none of them.

    Parameters
    ----------
    source
        Any file that `geofleet.formats.layers.read_layer` reads, a `reference` table too.
    out
        File to write, of any suffix that `geofleet convert` writes.
    how
        Shares and metres.
    seed
        Of all draws. They depend on it and on the ids of the signs alone.
    options
        Of the reader.

    Raises
    ------
    InputError
        The layer cannot be read, has no main sign, or has one class and signs are to be retyped.
    ConfigError
        The suffix is unknown, the layer holds several maps, or the seed is negative.
    """
    write = layer_writer(out)
    if not 0 <= seed < 2**63:
        raise ConfigError(f"the seed is {seed}.", todo="Set it between 0 and 2^63 - 1.")
    rows = _one_map(read_layer(source, **options).table, source)
    main = np.flatnonzero(pc.equal(rows["kind"], "main").to_numpy())
    if not len(main):
        raise InputError("there is no main sign to make an outdated copy of.", where=str(source))
    (lon, lat), ids = lonlat(rows), rows["sign_id"].to_pylist()
    keys = sign_keys(ids)
    codes = rows["sign_class"].combine_chunks().dictionary_encode().indices.to_numpy()
    copy = make_stale(keys[main], lon[main], lat[main], codes[main], how, seed=seed)
    drift = Staleness(sigma_m=how.sigma_m, shift_m=how.shift_m)
    others = make_stale(keys, lon, lat, codes, drift, seed=seed)
    table = _table(
        rows, main, copy, (others.lon_deg, others.lat_deg), sigma_m=how.sigma_m, label=f"simulated, seed {seed}"
    )
    changes = out.with_name(f"{out.stem}_changes.csv")
    write(SIGNS, table, out)
    with atomic_path(changes) as draft:
        write_csv(_changes(rows.take(main), copy), draft)
    counts = {name: int((copy.fate == code).sum()) for code, name in enumerate(FATES[:-1])}
    return StaleResult(out, changes, table.num_rows, len(main), counts | {FATES[-1]: len(copy.key)})


def _one_map(table: pa.Table, path: Path) -> pa.Table:
    """Return the signs of a layer by id, each once, without the columns that tie a map to a run."""
    names = [name for name in ("method", "n_vehicles", "run_id") if name in table.column_names]
    if "method" in names and table.group_by(names).aggregate([]).num_rows > 1:
        raise ConfigError("the layer holds several maps.", where=str(path), todo="Give one run, method and fleet size.")
    plain = table.drop_columns([name for name in _OF_A_RUN if name in table.column_names]).sort_by("sign_id")
    ids = np.array(plain["sign_id"].to_pylist(), object)
    is_first = np.append(True, ids[1:] != ids[:-1])
    first = np.flatnonzero(is_first)
    place = np.column_stack(lonlat(plain))
    elsewhere = (place != place[first[np.cumsum(is_first) - 1]]).any(axis=1)
    if elsewhere.any():
        raise InputError(
            f"sign {ids[elsewhere.argmax()]} stands at two places: its runs are of different scenes.",
            where=str(path),
            todo="Give one scene.",
        )
    return plain.take(first)


def _table(
    rows: pa.Table, main: Ints, copy: StaleSigns, others: tuple[Floats, Floats], *, sigma_m: float, label: str
) -> pa.Table:
    """Return the copy as a `signs` table: what is left of the rows, then the obsolete signs."""
    n = len(main)
    kept, place = _rows_of_copy(rows, main, copy, others)
    row = np.concatenate((np.flatnonzero(kept), main[copy.like]))  # that a sign of the copy is made from
    class_row = np.arange(rows.num_rows)
    class_row[main] = main[copy.class_of[:n]]
    class_row = np.concatenate((class_row[kept], main[copy.class_of[n:]]))
    signs = rows.take(row)
    is_new = np.arange(len(row)) >= kept.sum()
    columns = {name: signs[name] for name in signs.column_names if name not in (GEOMETRY, BBOX)}
    columns |= {name: rows[name].take(pa.array(class_row)) for name in _OF_A_CLASS}
    ids = rows["sign_id"].filter(pa.array(kept)).to_pylist() + [f"s{key:016x}" for key in copy.key.tolist()]
    columns |= {
        "sign_id": ids,
        "support_id": pc.if_else(pa.array(is_new), None, signs["support_id"]),
        "source": [f"{source} (outdated copy: {label})" for source in signs["source"].to_pylist()],
        "source_ref": np.where(is_new, np.array(ids, object), np.array(signs["source_ref"].to_pylist(), object)),
    }
    if sigma_m:
        columns |= {name: _plus(signs, name, sigma_m**2) for name in ("var_e_m2", "var_n_m2")}
        columns["cov_en_m2"] = _plus(signs, "cov_en_m2", 0.0)
    lon, lat = (
        np.concatenate((side[kept], of_copy[n:]))
        for side, of_copy in zip(place, (copy.lon_deg, copy.lat_deg), strict=True)
    )
    return build_table(SIGNS, columns, geometry=(lon, lat))


def _rows_of_copy(
    rows: pa.Table, main: Ints, copy: StaleSigns, others: tuple[Floats, Floats]
) -> tuple[Flags, tuple[Floats, Floats]]:
    """Tell which rows are in the copy and where they stand: a plate goes with its main sign."""
    n = len(main)
    kept, place = np.ones(rows.num_rows, bool), [side.copy() for side in others]
    kept[main] = copy.fate != REMOVED
    place[0][main], place[1][main] = copy.lon_deg[:n], copy.lat_deg[:n]
    ids = {name: row for row, name in enumerate(rows["sign_id"].to_pylist())}
    parent = np.array([ids.get(name, -1) for name in rows["parent_id"].to_pylist()], np.int64)
    plate = np.flatnonzero((parent >= 0) & ~np.isin(np.arange(len(parent)), main))
    carrier = parent[plate]
    kept[plate] = kept[carrier]
    for side, given in zip(place, lonlat(rows), strict=True):
        side[plate] = given[plate] + (side[carrier] - given[carrier])
    return kept, (place[0], place[1])


def _plus(signs: pa.Table, name: str, variance_m2: float) -> Floats:
    """Return a variance with that of the copy on top; what a layer does not state counts as none."""
    own = signs[name].to_numpy() if name in signs.column_names else np.zeros(signs.num_rows)
    total: Floats = np.nan_to_num(own.astype(np.float64)) + variance_m2
    return total


def _changes(main: pa.Table, copy: StaleSigns) -> list[dict[str, Any]]:
    """Return a row a main sign: what became of it, its class and place before and in the copy."""
    n = main.num_rows
    classes, ids = main["sign_class"].to_pylist(), main["sign_id"].to_pylist()
    lon, lat = lonlat(main)
    moved_m = distance_m(lon, lat, copy.lon_deg[:n], copy.lat_deg[:n])
    rows = []
    for i in range(n):
        is_there = copy.fate[i] != REMOVED
        stale_class = classes[copy.class_of[i]] if is_there else None
        offset_m = round(float(moved_m[i]), 4) if is_there else None
        rows.append(
            {
                "sign_id": ids[i],
                "fate": FATES[copy.fate[i]],
                "true_class": classes[i],
                "stale_class": stale_class,
                "offset_m": offset_m,
            }
        )
    for key, of in zip(copy.key.tolist(), copy.class_of[n:].tolist(), strict=True):
        rows.append(
            {
                "sign_id": f"s{key:016x}",
                "fate": FATES[OBSOLETE],
                "true_class": None,
                "stale_class": classes[of],
                "offset_m": None,
            }
        )
    return rows
