"""The inside world: schemas, GeoParquet store, DuckDB."""
