"""The inventory: what was found of the assets and what people changed, a table a kind; nobody's work is lost.

Its truth is appended and never changed (`store/asset_truth.py`); everything else is a view of it.
"""
