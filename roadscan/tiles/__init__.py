"""The 10 m grid, footprints, blocks and halos, cells."""
