"""The inventory: what was found of the assets and what people changed, as one table a kind that nobody's work is lost from.

Its truth is appended and never changed (`tables/asset_truth.py`); everything else is a view of it.
"""
