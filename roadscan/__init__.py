"""roadscan: raw logs of a road survey in, survey-grade pavement surfaces out."""

__version__ = "0.1.0"
