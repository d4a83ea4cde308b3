"""Pictures of assets: the best views of an object, its cut-outs, its colours."""
