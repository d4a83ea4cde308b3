"""SQL over the tables of one store and of a fleet of stores, by DuckDB."""
