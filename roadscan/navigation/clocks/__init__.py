"""Clocks of sensors: estimated from pairs of stamps or from shared motion, and what an estimate corrects."""

from roadscan.navigation.clocks.correction import ClockCorrection, Residuals

__all__ = ["ClockCorrection", "Residuals"]
