"""Parts of the site, a file a part."""
