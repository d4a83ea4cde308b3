"""Kinds of assets, each one file with one :class:`~roadscan.assets.kind.AssetKind`."""
