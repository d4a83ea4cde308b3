"""Parquet pages of profiles, returns and cells, which Arrow writes and reads in twice to five times the time.

Any reader of Parquet opens the files; pyarrow is their oracle in tests, and their stand-in.
"""
