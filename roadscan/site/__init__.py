"""The published site: documents for a page in a browser, made from a survey's tables, cells and points."""
