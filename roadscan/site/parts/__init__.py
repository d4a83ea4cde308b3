"""Parts of the site, one per file."""
