"""Runs tasks in this process or on Dask, singly or in bundles; computes keys of outputs."""
