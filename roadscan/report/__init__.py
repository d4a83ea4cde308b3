"""The report: one page about a survey, to read, to print and to keep."""
