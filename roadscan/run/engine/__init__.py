"""What runs tasks: in this process or on Dask, alone or in bundles; keys of outputs."""
