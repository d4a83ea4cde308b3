"""The inventory: assets as they were found and as people changed them, one table a kind; no one's work is lost.

Its truth is an append-only log (`store/asset_truth.py`); everything else is derived from it.
"""
