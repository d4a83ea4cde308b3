"""The Parquet store: schemas, partitions, manifest, SQL."""
