"""Kinds of assets: a file holds one :class:`~roadscan.assets.kind.AssetKind`, or several that are found together."""
