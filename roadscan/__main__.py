"""``python -m roadscan``."""

from roadscan.cli import main

main()
