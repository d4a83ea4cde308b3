"""Roughness regions: dim patches of the road's surface, found in sections and measured (Kumar & Angelats 2017)."""
