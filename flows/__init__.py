"""Prefect flows: pages of stage names, no formula."""
