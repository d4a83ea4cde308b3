"""The published site: documents that a page in a browser reads, from the tables, cells and points of a survey."""
