"""What pictures tell of assets: which show an object best, its cut-outs, its colours."""
