"""Prefect flows: pages of stage names, no formula."""

import os

# A run without a Prefect API starts a throw-away server; it sends usage figures only if the user says so.
os.environ.setdefault("PREFECT_SERVER_ANALYTICS_ENABLED", "false")
